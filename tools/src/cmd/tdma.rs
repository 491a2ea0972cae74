//! `rtnet tdma`.

use std::time::{Duration, Instant};

use anyhow::{Result, anyhow, bail};
use rtnet::time::Span;

use super::Failure;
use crate::cli::{TdmaArgs, TdmaVerb, Which, WhichOf};
use crate::control::{
    self, Directory, LabReply, LabRequest, MemberStatus, Place, Question, Reply, Request, RingShown,
    RoleRequest, SlotRequest, SlotShown, StationStatus,
};
use crate::report::document::document;
use crate::report::text::{Column, grouped, micros, table};
use crate::station::link::Standing;
use crate::station::misses::{Miss, Misses, Refusal};

/// Columns of a table of slots.
const WIDTH: usize = 100;
/// A master-to-be listens for three cycles, and is looked at ten times a second.
const LISTENED_AT_MOST: u32 = 6;
const SPOKEN_WITHIN: Duration = Duration::from_secs(2);
const NAMED_WITHIN: Duration = Duration::from_millis(200);

/// Looks at a station, or changes its role.
pub fn tdma(args: &TdmaArgs) -> Result<u8, Failure> {
    let which = &found_of(&args.which)?;
    let role = match args.verb {
        TdmaVerb::Status { misses: only } => {
            let status = with_names(which, status(which).map_err(Failure::Usage)?);
            super::print(which.json, &status, if only { misses } else { describe }).map_err(Failure::Run)?;
            return Ok(0);
        }
        TdmaVerb::Master { cycle } => RoleRequest::Master { cycle_ns: cycle.nanos() },
        TdmaVerb::Slave { rounds, servo, delay, holdover, on_master_change } => {
            RoleRequest::Slave { rounds, servo, delay, holdover, on_master_change }
        }
        TdmaVerb::Calibrate { rounds } => {
            let from = applied(which, Request::Calibrate { rounds }).map_err(Failure::Usage)?;
            let so_far = ", while it keeps its slots; `status` tells how far it is";
            return told(which, from, &format!("{}: calibrates anew", which.place), so_far);
        }
        TdmaVerb::Detach => RoleRequest::Detached,
    };
    let Place { lab, station } = which.place.clone();
    let from = match lab {
        None => applied(which, Request::Become(role)),
        Some(lab) => by_lab(&lab, LabRequest::Become { station, role }),
    };
    let from = from.map_err(Failure::Usage)?;
    if let RoleRequest::Master { cycle_ns } = role {
        let from = until_it_speaks(which, Duration::from_nanos(cycle_ns.unsigned_abs()))?;
        return told(which, from, &format!("{}: {}", which.place, became(role)), "");
    }
    told(which, from, &format!("{}: {}", which.place, became(role)), "")
}

/// With the lab in which it is, if it is one of the only lab.
pub fn found(which: &Which) -> Result<Which, Failure> {
    let place =
        Directory::of_user().and_then(|directory| directory.find(&which.place)).map_err(Failure::Usage)?;
    Ok(Which { place, json: which.json })
}

/// The same where `-S` stands on either side, and so may not.
pub fn found_of(which: &WhichOf) -> Result<Which, Failure> {
    let Some(place) = which.place.clone() else {
        let there = Directory::of_user().map_err(Failure::Usage)?.stations();
        let there =
            if there.is_empty() { "none runs here".into() } else { format!("there is {}", there.join(", ")) };
        return Err(Failure::Usage(anyhow!("which station is meant? Say it: -S [LAB/]STATION; {there}")));
    };
    found(&Which { place, json: which.json })
}

/// Waits until a station that listens before it gives the time does so; its cycle then.
fn until_it_speaks(which: &Which, cycle: Duration) -> Result<u32, Failure> {
    let deadline = Instant::now() + SPOKEN_WITHIN + cycle * LISTENED_AT_MOST;
    let mut asked = None;
    loop {
        let StationStatus { role, standing, .. } = status(which).map_err(Failure::Run)?;
        // What is told first may be of before.
        let is_new = *asked.get_or_insert(standing.at) != standing.at;
        let place = &which.place;
        match &standing.yielded_to {
            Some(other) if is_new => {
                return Err(Failure::Run(anyhow!(
                    "station '{place}' makes way for another master ({other}): stop that one and ask \
                     again, or let this one follow it (`rtnet tdma -S {place} slave`)"
                )));
            }
            _ if is_new && role == "master" && standing.state == "locked" => return Ok(standing.cycle),
            _ if Instant::now() > deadline => {
                let state = &standing.state;
                return Err(Failure::Run(anyhow!(
                    "station '{place}' is {role}, {state}, and gives no time yet: `rtnet tdma -S {place} status` tells \
                     how it goes on"
                )));
            }
            _ => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// Asks a station where it stands.
pub fn status(which: &Which) -> Result<StationStatus> {
    control::station_status(&Directory::of_user()?, &which.place)
}

/// Asks for a change; the cycle from which it holds.
pub fn applied(which: &Which, request: Request) -> Result<u32> {
    match control::ask(&Directory::of_user()?, &which.place, request)? {
        Reply::Applied(from) => Ok(from),
        Reply::Refused(why) => Err(anyhow!("station '{}': {why}", which.place)),
        _ => bail!("station '{}' answers what it was not asked", which.place),
    }
}

/// A lab knows all its stations, so it is asked instead of the one.
pub fn by_lab(lab: &str, request: LabRequest) -> Result<u32> {
    match control::ask_lab(&Directory::of_user()?, lab, request)? {
        LabReply::Applied(from) => Ok(from),
        LabReply::Refused(why) => Err(anyhow!("lab '{lab}': {why}")),
        _ => bail!("lab '{lab}' answers what it was not asked"),
    }
}

/// From when on a change holds.
#[derive(serde::Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Applied {
    /// The first cycle in which it does.
    from_cycle: u32,
}

document!(Applied, "applied", applied_has_its_schema);

/// Tells of a change that was made.
pub fn told(which: &Which, from: u32, what: &str, so_far: &str) -> Result<u8, Failure> {
    let line = |_: &Applied| format!("{what}, from cycle {from} on{so_far}\n");
    super::print(which.json, &Applied { from_cycle: from }, line).map_err(Failure::Run)?;
    Ok(0)
}

fn became(role: RoleRequest) -> String {
    match role {
        RoleRequest::Master { cycle_ns } => {
            format!("master of a cycle of {}", Span::from_nanos(cycle_ns))
        }
        RoleRequest::Slave { rounds: 0, .. } => "slave, without calibration".into(),
        RoleRequest::Slave { rounds, .. } => format!("slave, after {rounds} calibration rounds"),
        RoleRequest::Detached => "detached".into(),
    }
}

/// A station in words.
pub fn describe(status: &StationStatus) -> String {
    let standing = &status.standing;
    let has_cycle = status.discipline == "tdma";
    let mut text = if has_cycle {
        in_the_cycle(status)
    } else {
        format!("{}: {}, {}\n", status.name, status.discipline, standing.state)
    };
    let StationStatus { interface, address, link, pid, guard, .. } = status;
    text += &format!("on {interface} ({address}, {link}), process {pid}");
    text += &if has_cycle || status.ring.is_some() { format!(", {guard} guard\n") } else { "\n".into() };
    text += &status.ring.as_ref().map_or(String::new(), RingShown::describe);
    text += &masters(status);
    if has_cycle {
        text += &format!("\n{}", slots(status));
    }
    for (title, counts) in [
        ("counters", &status.counters),
        ("refused frames", &standing.refusals),
        ("requests", &status.control),
    ] {
        let shown: Vec<String> =
            counts.iter().filter(|(_, n)| **n > 0).map(|(name, n)| format!("{name} {n}")).collect();
        if !shown.is_empty() {
            text += &format!("\n{title}: {}\n", shown.join(", "));
        }
    }
    status.host.iter().for_each(|line| text += &format!("\nhost: {line}\n"));
    text
}

/// Its part in the cycle, and what it knows of the time.
fn in_the_cycle(status: &StationStatus) -> String {
    let standing = &status.standing;
    let span = |ns: Option<i64>, none: &str| ns.map_or(none.into(), |ns| Span::from_nanos(ns).to_string());
    let mastery = status.mastery.as_ref().map_or(String::new(), |mastery| format!(" ({mastery})"));
    let mut text = format!(
        "{}: {}{mastery}, {}, cycle {} of {}\n",
        status.name,
        status.role,
        standing.state,
        standing.cycle,
        span(status.period_ns, "unknown length"),
    );
    if standing.delay_ns.is_some() || status.role == "slave" {
        text += &format!(
            "delay {}, clock drift {}, last sync {} beside the time line\n",
            span(standing.delay_ns, "not measured"),
            status.drift_ppb.map_or("not known yet".into(), |ppb| format!("{:+.3} ppm", ppb as f64 / 1e3)),
            Span::from_nanos(status.deviation_ns)
        );
        let measures_anew = standing.delay_ns.is_some();
        text += &status.clock.as_ref().map_or(String::new(), |clock| clock.describe(measures_anew));
    }
    if let Some(global) = status.global_ns {
        text += &format!("global time {}.{:09}\n", global / 1_000_000_000, global % 1_000_000_000);
    }
    text
}

/// Who gives the time, as far as it knows.
fn masters(status: &StationStatus) -> String {
    let Standing { yielded_to, time_by, rival, .. } = &status.standing;
    let who = |of: &String| status.names.get(of).map_or(of.clone(), |name| format!("{name} ({of})"));
    let followed = time_by.as_ref().filter(|of| **of != status.address);
    let lines = [
        followed.map(|of| format!("follows {}\n", who(of))),
        rival.as_ref().map(|of| format!("{} gives the time, too\n", who(of))),
        yielded_to.as_ref().map(|of| format!("makes way for the master {}\n", who(of))),
    ];
    lines.into_iter().flatten().collect()
}

/// A station knows addresses; its lab, whose they are.
fn with_names(which: &Which, mut status: StationStatus) -> StationStatus {
    let Standing { yielded_to, time_by, rival, .. } = &status.standing;
    let told: Vec<&String> = [yielded_to, time_by, rival].into_iter().flatten().collect();
    let lab = which.place.lab.as_ref().filter(|_| !told.is_empty());
    let stations = lab.and_then(|lab| stations(lab)).into_iter().flatten();
    let named = stations.filter(|station| told.contains(&&station.address));
    status.names = named.map(|station| (station.address, station.name)).collect();
    status
}

/// A lab that is busy is not waited for: addresses will do.
pub fn stations(lab: &str) -> Option<Vec<MemberStatus>> {
    let path = Directory::of_user().ok()?.lab(lab);
    let mut question = Question::put(&path, LabRequest::Status, NAMED_WITHIN).ok()?;
    match question.answer(NAMED_WITHIN).ok()?? {
        LabReply::Status(status) => Some(status.stations),
        _ => None,
    }
}

/// What was missed, in words.
fn misses(status: &StationStatus) -> String {
    let Misses { causes, worst, refused, .. } = &status.misses;
    if causes.is_empty() {
        return format!("{}: nothing missed\n", status.name);
    }
    let counts: Vec<String> =
        causes.iter().map(|(cause, n)| format!("{} {}", cause.replace('_', " "), grouped(*n))).collect();
    let mut text = format!("{}: missed by cause: {}\n", status.name, counts.join(", "));
    for Refusal { error, frames, last_cycle, .. } in refused {
        let (frames, last) = (grouped(*frames), grouped((*last_cycle).into()));
        text += &format!("\nsend failed: {error}: {frames}, the last in cycle {last}\n");
    }
    if !worst.is_empty() {
        text += &format!("\n{}\n", longest(worst, None));
    }
    text
}

/// Those that were late, as a table; with whose they are, if they are several stations'.
pub fn longest(worst: &[Miss], whose: Option<Vec<String>>) -> String {
    let left = |head, cell: fn(&Miss) -> String| Column::left(["", head], worst.iter().map(cell));
    let mut columns = vec![
        left("the longest", |miss| miss.what.replace('_', " ")),
        Column::right(["", "cycle"], worst.iter().map(|miss| grouped(miss.cycle.into()))),
        Column::right(
            ["", "slot"],
            worst.iter().map(|miss| miss.slot.map_or("-".into(), |id| id.to_string())),
        ),
        Column::right(["", "by us"], worst.iter().map(|miss| micros(miss.late_ns))),
        left("cause", |miss| miss.cause.replace('_', " ")),
    ];
    if let Some(names) = whose {
        columns.insert(1, Column::left(["", "station"], names.into_iter()));
    }
    table(&columns, WIDTH).join("\n")
}

/// The slots as a table.
pub fn slots(status: &StationStatus) -> String {
    let slots = &status.slots;
    if slots.is_empty() {
        return "no slots\n".into();
    }
    let right = |head, cell: fn(&SlotShown) -> String| Column::right(["", head], slots.iter().map(cell));
    let span = |ns| Span::from_nanos(ns).to_string();
    let wait = |shown: &SlotShown| {
        super::waits::worst(status, shown.slot.id).map_or("-".into(), |wait| wait.to_string())
    };
    let lines = table(
        &[
            Column::left(["", "slot"], slots.iter().map(|shown| slot_name(&shown.slot))),
            Column::right(["", "offset"], slots.iter().map(|shown| span(shown.slot.offset_ns))),
            right("phase", |shown| format!("{}/{}", shown.slot.phase + 1, shown.slot.period)),
            right("size", |shown| shown.slot.size.to_string()),
            Column::right(["", "latest"], slots.iter().map(|shown| span(shown.latest_ns))),
            Column::right(["", "worst wait"], slots.iter().map(wait)),
            right("queued", |shown| shown.queued.to_string()),
            right("sent", |shown| grouped(shown.sent)),
        ],
        WIDTH,
    );
    lines.join("\n") + "\n"
}

/// A slot's id; behind it, as in RTnet, that of the slot whose queue it takes from, if not its own.
pub fn slot_name(slot: &SlotRequest) -> String {
    slot.joint.map_or(slot.id.to_string(), |joint| format!("{}->{joint}", slot.id))
}

#[cfg(test)]
mod tests;
