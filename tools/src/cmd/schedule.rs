//! `rtnet schedule`.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow, bail, ensure};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::Failure;
use super::tdma::{by_lab, found_of, slot_name};
use crate::cli::{ScheduleArgs, ScheduleVerb, Which};
use crate::control::{
    self, ActivationSaid, Directory, LabRequest, Reply, Request, ScheduleRequest, ScheduleSaid,
    ScheduleShown, SlotRequest,
};
use crate::scenario::{self, Scenario};

/// How often to look how far a change is.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// A change that goes on tells of itself; one whose master has gone does not.
const GIVEN_UP_AFTER: Duration = Duration::from_secs(60);

/// Looks at the schedule of a running network, or changes it.
pub fn schedule(args: &ScheduleArgs) -> Result<u8, Failure> {
    let which = &found_of(&args.which)?;
    let before = shown(which).map_err(Failure::Usage)?;
    match &args.verb {
        ScheduleVerb::Show => tell(which, &before),
        ScheduleVerb::Propose { file, addresses, when } => {
            propose(which, file, addresses, when.said()).map_err(Failure::Usage)?;
            let is_done = |now: &ScheduleShown| match when.said() {
                None => now.state == "proposed" && now.acknowledged == now.asked,
                Some(_) => now.switched > before.switched,
            };
            tell(which, &wait(which, &before, is_done)?)
        }
        ScheduleVerb::Activate { when } => {
            let said = when.said().unwrap_or(ActivationSaid::Soon);
            asked(which, ScheduleRequest::Activate(said)).map_err(Failure::Usage)?;
            tell(which, &wait(which, &before, |now| now.switched > before.switched)?)
        }
        ScheduleVerb::Cancel => {
            asked(which, ScheduleRequest::Cancel).map_err(Failure::Usage)?;
            tell(which, &wait(which, &before, |now| ["cancelled", "idle"].contains(&now.state.as_str()))?)
        }
    }
}

fn propose(
    which: &Which,
    file: &Path,
    addresses: &[(String, Address)],
    activate: Option<ActivationSaid>,
) -> Result<()> {
    let scenario = scenario::load_schedule(file)?;
    match &which.place.lab {
        // A lab knows its stations by their names, and judges all slots together.
        Some(lab) => {
            ensure!(addresses.is_empty(), "--address: a lab knows its stations by their names; leave it out");
            let names = |id: usize| scenario.stations[id].name.clone();
            let schedule = Box::new(ScheduleSaid::of(&scenario, names));
            let station = which.place.station.clone();
            by_lab(lab, LabRequest::Propose { station, schedule, activate }).map(drop)
        }
        None => {
            let schedule = Box::new(by_address(&scenario, file, addresses)?);
            asked(which, ScheduleRequest::Propose { schedule, activate })
        }
    }
}

/// A file's schedule for stations that were started one by one.
fn by_address(scenario: &Scenario, file: &Path, addresses: &[(String, Address)]) -> Result<ScheduleSaid> {
    let file = file.display();
    for (name, _) in addresses {
        ensure!(
            scenario.stations.iter().any(|station| station.name == *name),
            "--address: {file} has no station '{name}'"
        );
    }
    let said =
        |name: &str| addresses.iter().find(|(of, _)| of == name).map(|(_, address)| address.to_string());
    for station in scenario.stations.iter().filter(|station| !station.slots.is_empty()) {
        let name = &station.name;
        ensure!(said(name).is_some(), "which station is '{name}' of {file}? say --address {name}=ADDRESS");
    }
    Ok(ScheduleSaid::of(scenario, |id| said(&scenario.stations[id].name).unwrap_or_default()))
}

fn asked(which: &Which, request: ScheduleRequest) -> Result<()> {
    match control::ask(&Directory::of_user()?, &which.place, Request::Schedule(request))? {
        Reply::Applied(_) => Ok(()),
        Reply::Refused(why) => Err(anyhow!("station '{}': {why}", which.place)),
        _ => bail!("station '{}' answers what it was not asked", which.place),
    }
}

fn shown(which: &Which) -> Result<ScheduleShown> {
    let show = Request::Schedule(ScheduleRequest::Show);
    match control::ask(&Directory::of_user()?, &which.place, show)? {
        Reply::Schedule(shown) => Ok(*shown),
        Reply::Refused(why) => Err(anyhow!("station '{}': {why}", which.place)),
        _ => bail!("station '{}' answers what it was not asked", which.place),
    }
}

/// Waits until it is done, or stopped: what is told is ten times a second new.
fn wait(
    which: &Which,
    before: &ScheduleShown,
    is_done: impl Fn(&ScheduleShown) -> bool,
) -> Result<ScheduleShown, Failure> {
    let deadline = Instant::now() + GIVEN_UP_AFTER;
    loop {
        let now = shown(which).map_err(Failure::Run)?;
        // What is shown may be of before it was asked for.
        let is_new = now.cycle != before.cycle;
        if is_new && is_done(&now) {
            return Ok(now);
        }
        let is_over = ["cancelled", "idle", "unsure"].contains(&now.state.as_str());
        if let (true, true, Some(why)) = (is_new, is_over, &now.stopped) {
            let number = now.admin.unwrap_or_default();
            return Err(Failure::Run(anyhow!("change {number} is stopped, and all go on as before: {why}")));
        }
        if Instant::now() > deadline {
            return Err(Failure::Run(anyhow!(
                "the change is not done after {}s: `rtnet schedule -S {} show` tells how far it is",
                GIVEN_UP_AFTER.as_secs(),
                which.place
            )));
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

fn tell(which: &Which, shown: &ScheduleShown) -> Result<u8, Failure> {
    super::print(which.json, shown, words).map_err(Failure::Run)?;
    Ok(0)
}

fn words(shown: &ScheduleShown) -> String {
    let ScheduleShown { station, in_use, oper, admin, state, activation, .. } = shown;
    let named = |number: u16| match number {
        0 => "the one that it was started with".to_owned(),
        number => format!("number {number}"),
    };
    let mut text = format!("{station}: schedule in use: {}{}\n", named(*in_use), slots(shown));
    match oper {
        None => text += "nobody has said which is in use: the master says nothing of it, or was not heard\n",
        Some(oper) if oper != in_use => {
            text +=
                &format!("the acting master says {}: it is collected, and nothing is sent\n", named(*oper));
        }
        Some(_) => {}
    }
    let at = activation.map_or(String::new(), |cycle| format!(" cycle {cycle}"));
    let change = admin.map_or(String::new(), |number| format!("change {number}: "));
    text += &match state.as_str() {
        "proposed" => format!("{change}proposed\n"),
        "committed" => format!("{change}to be used from{at} on, if all who may give the time confirm\n"),
        "sealed" => format!("{change}to be used from{at} on\n"),
        "switched" => format!("{change}in use from{at} on\n"),
        "cancelled" => format!("{change}withdrawn\n"),
        "unsure" => "who gives the time does not know which is in use: nobody sends\n".into(),
        _ => "no change is pending\n".into(),
    };
    if shown.acts && shown.asked > 0 {
        let ScheduleShown { asked, acknowledged, masters, confirmed, .. } = shown;
        text += &format!(
            "{acknowledged} of {asked} stations have acknowledged, {confirmed} of {masters} that may give the time confirmed\n"
        );
        if let (Some(waits_for), "proposed") = (&shown.waits_for, state.as_str()) {
            text += &format!("waits for {waits_for}\n");
        }
    }
    if let Some(why) = shown.stopped.as_ref().filter(|_| state != "proposed") {
        text += &format!("the last change was stopped: {why}\n");
    }
    text
}

/// The cycle, and the station's own slots in it.
fn slots(shown: &ScheduleShown) -> String {
    let cycle = shown.period_ns.map_or(String::new(), |ns| format!(", cycle {}", Span::from_nanos(ns)));
    let one = |slot: &SlotRequest| {
        let turn =
            if slot.period > 1 { format!(" ({}/{})", slot.phase + 1, slot.period) } else { String::new() };
        format!("{} at {}{turn}", slot_name(slot), Span::from_nanos(slot.offset_ns))
    };
    match &shown.slots[..] {
        [] => cycle,
        all => format!("{cycle}, slots {}", all.iter().map(one).collect::<Vec<_>>().join(", ")),
    }
}
