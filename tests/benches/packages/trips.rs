//! There and back between two processes: who starts them, and what they do.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use serde_json::Value;

use crate::Cores;
use crate::bare::{BareEnd, Hung};
use crate::exchange::{End, Way, echoes, pings, set_up};
use crate::mailboxes::MailboxEnd;
use crate::mqueue::{Names, QueueEnd};
use crate::process::Process;
use crate::station::Station;

const SIDES: [&str; 2] = ["asks", "answers"];

pub fn measure(what: &str, way: Way, cores: Cores, time: Duration) -> Result<Value> {
    let unique = std::process::id().to_string();
    match what {
        "mailbox" => {
            let station = Station::new()?;
            between(None, what, way, cores, time, station.place()?)
        }
        "mqueue" => {
            let _queues = Names::new(&unique)?;
            between(None, what, way, cores, time, &unique)
        }
        "bells" => {
            let hung = Hung::new()?;
            between(None, what, way, cores, time, &hung.place())
        }
        "iceoryx2" => {
            let peer = std::env::var("RTNET_PEER").context("RTNET_PEER says where its program is")?;
            between(Some(&peer), what, way, cores, time, &unique)
        }
        _ => bail!("mailbox, bells, mqueue or iceoryx2"),
    }
}

/// Two processes, of this or of another program.
fn between(
    program: Option<&str>,
    what: &str,
    way: Way,
    cores: Cores,
    time: Duration,
    place: &str,
) -> Result<Value> {
    let time = time.as_secs_f64().to_string();
    let start = |number: usize| {
        let core = cores[number].to_string();
        let arguments = ["trips", SIDES[number], what, way.name(), &core, &time, place];
        program.map_or_else(|| Process::own(&arguments), |program| Process::start(program, &arguments))
    };
    let mut answers = start(1)?;
    answers.line()?;
    start(0)?.figures()
}

/// One of them.
pub fn child(side: &str, what: &str, way: Way, core: usize, time: Duration, place: &str) -> Result<()> {
    let number = SIDES.iter().position(|&known| known == side).context("asks or answers")?;
    let told = || {
        if number == 1 {
            println!("ready")
        }
    };
    match what {
        "mailbox" => {
            let end = MailboxEnd::open(Path::new(place), way, number, told)?;
            run(end, number, way, core, time)
        }
        "mqueue" => {
            let end = QueueEnd::open(place, number)?;
            told();
            run(end, number, way, core, time)
        }
        "bells" => {
            let end = BareEnd::open(place, number)?;
            told();
            run(end, number, way, core, time)
        }
        _ => bail!("mailbox, bells or mqueue"),
    }
}

fn run(mut end: impl End, number: usize, way: Way, core: usize, time: Duration) -> Result<()> {
    set_up(way, core);
    if number == 1 {
        return echoes(&mut end);
    }
    println!("{}", pings(&mut end, time)?);
    Ok(())
}
