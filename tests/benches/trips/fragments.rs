//! Datagrams of many fragments in slots, one after the other.

use std::sync::PoisonError;
use std::time::Duration;

use anyhow::{Result, anyhow, ensure};
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_REQUESTS, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, RoleConfig,
    SlaveConfig, SlotConfig, Tdma, TdmaConfig,
};
use rtnet::live::GuardMode;
use rtnet::live::clock::{monotonic, realtime};
use rtnet::socket::{Access, Flags, Program};
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use serde_json::{Value, json};
use tests::stacks::{self, CYCLE, Does, Notes, Own, address, at};
use tools::lab::namespace::Namespace;

use crate::stations::{Plan, Running};
use crate::{Cores, Way};

const DATAGRAM: usize = 60_000;
const PORT: u16 = 2_000;
/// Of an IP header.
const HEADER: usize = 20;
/// Stations calibrate first.
const SETTLES: Duration = Duration::from_millis(1_500);
/// In virtual time, so many datagrams.
const DATAGRAMS: u64 = 100;

/// Bytes that the largest fragment has in a slot of this size.
fn fragment(size: usize) -> usize {
    (size - HEADER) & !7
}

/// Fragments of a datagram, its UDP header among them.
fn fragments(size: usize) -> u64 {
    (DATAGRAM + 8).div_ceil(fragment(size)) as u64
}

/// Has always another datagram ready to be sent.
fn floods(buffers: usize) -> Box<dyn Program> {
    let (mut own, data) = (Own::udp(PORT, buffers), stacks::bytes(DATAGRAM));
    Box::new(Does(move |sockets: &mut Access<'_>| {
        let id = own.id(sockets);
        while sockets.send_to(id, &data, at(0, PORT)).is_ok() {}
    }))
}

/// Notes when each datagram was whole.
fn hears(buffers: usize, whole: Notes<Instant>) -> Box<dyn Program> {
    let (mut own, mut room, data) = (Own::udp(PORT, buffers), vec![0; DATAGRAM], stacks::bytes(DATAGRAM));
    Box::new(Does(move |sockets: &mut Access<'_>| {
        let id = own.id(sockets);
        while let Ok(received) = sockets.receive(id, &mut room, Flags::NONE) {
            assert!(room == data, "it is what was sent");
            whole.lock().unwrap_or_else(PoisonError::into_inner).push(received.rx.unwrap_or(sockets.now()));
        }
    }))
}

/// Data that came from the first to the last, by what as many slots of the largest fragments would have had room for.
fn share(whole: &Notes<Instant>, size: usize) -> Result<Value> {
    let whole = whole.lock().unwrap_or_else(PoisonError::into_inner);
    let (Some(&first), Some(&last)) = (whole.first(), whole.last()) else {
        return Err(anyhow!("nothing came whole"));
    };
    ensure!(whole.len() > 1, "only one datagram came");
    let cycles = (last - first).nanos() as f64 / CYCLE.nanos() as f64;
    let came = (whole.len() - 1) as f64;
    Ok(json!({
        "n": whole.len(),
        "share": came * DATAGRAM as f64 / (cycles * fragment(size) as f64),
        "slots": came * fragments(size) as f64 / cycles,
    }))
}

pub fn in_virtual_time(size: usize) -> Result<Value> {
    ensure!((68..=1500).contains(&size), "a slot has 68 to 1500 bytes for IP");
    let (whole, buffers) = (Notes::default(), 2 * fragments(size) as usize + 8);
    let sends = vec![SlotConfig { size, ..stacks::slot(0, 500) }];
    let mut network = stacks::settled(vec![
        (vec![stacks::slot(0, 200)], stacks::stack(0, vec![hears(buffers, whole.clone())])),
        (sends, stacks::stack(1, vec![floods(buffers)])),
    ]);
    stacks::cycles(&mut network, (DATAGRAMS + 1) * fragments(size));
    share(&whole, size)
}

pub fn live(homes: &[Namespace; 2], cores: Cores, time: Duration) -> Result<Value> {
    let (whole, size) = (Notes::default(), 1_500);
    let start = |number: usize, program| {
        let plan =
            Plan { namespace: &homes[number], number, core: cores[number], way: Way::Block, is_open: false };
        Running::start(plan, tdma(number)?, vec![program], GuardMode::Auto)
    };
    let master = start(0, hears(128, whole.clone()))?;
    let slave = start(1, floods(128))?;
    std::thread::sleep(SETTLES);
    whole.lock().unwrap_or_else(PoisonError::into_inner).clear();
    std::thread::sleep(time);
    drop((master, slave));
    share(&whole, size)
}

fn tdma(number: usize) -> Result<Tdma> {
    let follow = SlaveConfig { rounds: 100, ..SlaveConfig::default() };
    // Half a cycle is nobody's.
    let late = Span::from_micros(200);
    let role = match number {
        0 => RoleConfig::Master(MasterConfig {
            cycle: CYCLE,
            sync_latest: late,
            reply_latest: late,
            epoch: Offset::between(Instant::from_nanos(monotonic()), GlobalTime::from_nanos(realtime())),
            resume: None,
            backup: None,
            backups_from: None,
            max_requests: DEFAULT_MAX_REQUESTS,
            behind_sync: None,
            follow,
        }),
        _ => RoleConfig::Slave(follow),
    };
    let (offset, size) = (Span::from_micros([300, 600][number.min(1)]), 1_500);
    let slots = vec![SlotConfig { id: 0, offset, phase: 0, period: 1, size, joint: None, latest: late }];
    let (max_slot_id, lead, late) = (DEFAULT_MAX_SLOT_ID, DEFAULT_LEAD, LatePolicy::Skip);
    let config = TdmaConfig { address: address(number), role, slots, max_slot_id, lead, late };
    Tdma::new(&config).map_err(|refused| anyhow!(refused))
}
