//! Many senders of different classes, and one who receives from them all: how long the most urgent one's packages take.
//!
//! ```text
//! who receives            SCHED_FIFO 75     a process
//! senders, by class       SCHED_FIFO 70 to 39, packages from 255 on: threads, each with a component of its own
//! ```
//!
//! Each sends again after half a period to one and a half, by chance, the same in every run: they meet as often as those do who
//! know nothing of each other.

use std::path::Path;
use std::sync::{Arc, Barrier};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use package_router::component::{Mailbox, Sender};
use package_router::mailbox::Shape;
use package_router::name::MailboxName;
use rtnet::live::clock::{monotonic, sleep_until, thread_cpu_time};
use rtnet::live::realtime::{RealTime, WarmCore};
use serde_json::{Value, json};

use crate::Cores;
use crate::exchange::MESSAGE;
use crate::figures::Times;
use crate::process::Process;
use crate::station::{Station, bound, mailbox, name};

const SINK: u8 = 0x08;
const SINK_PRIORITY: i32 = 75;
const MOST_URGENT: i32 = 70;
const SHAPE: Shape = Shape::new(16, MESSAGE).senders(32);
const WARM_UP: Duration = Duration::from_millis(100);
/// What a first guess is, and how it is made better.
const GUESS: u64 = 20_000;
const TRIES: usize = 3;
const TRY: Duration = Duration::from_millis(300);
/// About as long as the most urgent one's package takes when it is alone.
const LOOK: u64 = 3_000;

/// Kinds of packages.
const WARMS_UP: i8 = 1;
const COUNTS: i8 = 2;
const ENDS: i8 = 3;

/// What is to be measured.
pub struct Plan {
    /// How many send; the first is the most urgent. None: that one reads the clock for as long as a package takes, and how long
    /// that took is what is told.
    pub sending: usize,
    /// How many wake at their moments, whether they send or not: what timers take of the core is the kernel's.
    pub awake: usize,
    /// How many have a way to the mailbox.
    pub bound: usize,
    /// How often each sends, nanoseconds.
    pub period: u64,
    pub time: Duration,
}

/// One who sends.
struct Member {
    number: usize,
    period: u64,
    chance: u64,
    sender: Sender,
    /// It receives nothing, and is from there.
    _mailbox: Mailbox,
}

/// What a member has done.
struct Done {
    sent: u64,
    refused: u64,
    cpu: u64,
    looks: Option<Times>,
}

/// What one does when it wakes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Does {
    Send,
    Look,
    Nothing,
}

/// The class of each: from the most urgent on, which alone is of the highest level.
fn class(number: usize) -> u8 {
    if number == 0 { 1 } else { 0x10 + 7 * (number as u8 - 1) }
}

/// The period at which so many take that share of a core, with who receives.
pub fn pace(senders: usize, load: f64, cores: Cores) -> Result<Value> {
    let (mut period, mut is) = (GUESS * senders as u64, 0.0);
    for _ in 0..TRIES {
        let plan = Plan { sending: senders, awake: senders, bound: senders, period, time: TRY };
        is = measure(&plan, cores)?["load"].as_f64().context("a load")?;
        period = (period as f64 * is / load) as u64;
    }
    Ok(json!({ "period": period, "load": is }))
}

pub fn measure(plan: &Plan, cores: Cores) -> Result<Value> {
    ensure!(
        plan.bound <= SHAPE.senders && plan.sending <= plan.awake && plan.awake <= plan.bound,
        "{} senders at most",
        SHAPE.senders
    );
    let station = Station::new()?;
    let _warm = WarmCore::start(cores[1]).map_err(anyhow::Error::msg)?;
    let mut sink = Process::own(&["sink", &cores[1].to_string(), station.place()?])?;
    sink.line()?;
    let members = (0..plan.bound).map(|number| Member::new(station.path(), number, plan.period));
    let mut members = members.collect::<Result<Vec<_>>>()?;
    // Those who only have a way stay as long as the others send.
    let _silent = members.split_off(plan.awake);
    let done = run(members, plan, cores[0])?;
    let mut figures = sink.figures()?;
    if plan.sending == 0 {
        let looks = done.into_iter().next().and_then(|done| done.looks);
        return Ok(looks.context("it looks")?.figures());
    }
    ensure!(figures["n"].as_u64() > Some(0), "nothing came");
    let cpu: u64 =
        done.iter().map(|done| done.cpu).sum::<u64>() + figures["cpu"].as_u64().context("its time")?;
    let taken = done.iter().map(|done| done.sent).sum::<u64>();
    figures["load"] = json!(cpu as f64 / plan.time.as_nanos() as f64);
    figures["rate"] = json!(taken as f64 / plan.time.as_secs_f64());
    figures["lost"] = json!(done.iter().map(|done| done.refused).sum::<u64>());
    Ok(figures)
}

/// All of them at once; the most urgent one says that it is over when the others have sent all they will.
fn run(members: Vec<Member>, plan: &Plan, core: usize) -> Result<Vec<Done>> {
    let over = Arc::new(Barrier::new(members.len()));
    let begin = monotonic() + WARM_UP.as_nanos() as u64;
    let threads = members.into_iter().map(|mut member| {
        let (over, time) = (over.clone(), plan.time);
        let does = match member.number {
            number if number < plan.sending => Does::Send,
            0 => Does::Look,
            _ => Does::Nothing,
        };
        std::thread::spawn(move || -> Result<Done> {
            let priority = MOST_URGENT - member.number as i32;
            let realtime = RealTime { priority: Some(priority), cpu: Some(core) };
            realtime.apply().into_iter().for_each(|refused| eprintln!("{refused}"));
            let done = member.wakes(begin, time, does);
            over.wait();
            if member.number == 0 {
                member.sender.send(ENDS, &[])?;
            }
            done
        })
    });
    let threads: Vec<_> = threads.collect();
    threads
        .into_iter()
        .map(|thread| thread.join().map_err(|_| anyhow::anyhow!("a sender panicked"))?)
        .collect()
}

impl Member {
    fn new(place: &Path, number: usize, period: u64) -> Result<Self> {
        let mailbox = mailbox(place, name(class(number)), Shape::new(1, 0).senders(1))?;
        let sender = bound(&mailbox, name(SINK))?;
        let chance = 0x9e37_79b9_7f4a_7c15u64.wrapping_mul(number as u64 + 1);
        Ok(Self { number, period, chance, sender, _mailbox: mailbox })
    }

    /// Until it sends again: xorshift64.
    fn pause(&mut self) -> u64 {
        self.chance ^= self.chance << 13;
        self.chance ^= self.chance >> 7;
        self.chance ^= self.chance << 17;
        self.period / 2 + self.chance % self.period
    }

    fn wakes(&mut self, begin: u64, time: Duration, does: Does) -> Result<Done> {
        let counted = begin + WARM_UP.as_nanos() as u64;
        let until = counted + time.as_nanos() as u64;
        let mut done = Done { sent: 0, refused: 0, cpu: 0, looks: (does == Does::Look).then(Times::new) };
        let mut at = begin + self.pause();
        let mut before = None;
        while at < until {
            sleep_until(at);
            let kind = if at < counted { WARMS_UP } else { COUNTS };
            if kind == COUNTS {
                before.get_or_insert_with(thread_cpu_time);
            }
            at += self.pause();
            match does {
                Does::Nothing => {}
                Does::Look => {
                    let took = look();
                    done.looks.iter_mut().filter(|_| kind == COUNTS).for_each(|looks| looks.note(took));
                }
                Does::Send => match self.sender.send(kind, &[0x5a; MESSAGE]) {
                    Ok(_) => done.sent += u64::from(kind == COUNTS),
                    Err(_) => done.refused += 1,
                },
            }
        }
        done.cpu = thread_cpu_time() - before.context("it was too short")?;
        Ok(done)
    }
}

/// Reads the clock for a while: how long it took. Whatever takes the core from who sends takes it from this, too.
fn look() -> u64 {
    let begun = monotonic();
    loop {
        let took = monotonic() - begun;
        if took >= LOOK {
            return took;
        }
    }
}

/// In a process of its own: receives until the most urgent one says that it is over.
pub fn sink(core: usize, place: &str) -> Result<()> {
    let mut mailbox = mailbox(Path::new(place), name(SINK), SHAPE)?;
    println!("ready");
    let realtime = RealTime { priority: Some(SINK_PRIORITY), cpu: Some(core) };
    realtime.apply().into_iter().for_each(|refused| eprintln!("{refused}"));
    let urgent: MailboxName = name(class(0));
    let (mut times, mut room) = (Times::new(), [0; MESSAGE]);
    let mut before = None;
    loop {
        let package = mailbox.receive(None)?;
        let now = monotonic();
        package.body().copy_to(0, &mut room);
        let (from, kind, sent) = (package.head().from, package.head().kind, package.stamps().sent);
        drop(package);
        match kind {
            COUNTS => {
                before.get_or_insert_with(thread_cpu_time);
                if from == urgent {
                    times.note(now.saturating_sub(sent));
                }
            }
            ENDS => break,
            _ => {}
        }
    }
    let mut figures = times.figures();
    figures["cpu"] = json!(before.map_or(0, |before| thread_cpu_time() - before));
    println!("{figures}");
    Ok(())
}
