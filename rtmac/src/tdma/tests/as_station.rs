//! A role in a station, for what only the whole makes of it.

use super::*;
use crate::wire::Message;

/// Lets the station act that is this role, and has no slots.
pub fn as_station<T>(
    own: Address,
    role: &mut Role,
    events: &mut Events,
    act: impl FnOnce(&mut Tdma) -> T,
) -> T {
    let follow = SlaveConfig { rounds: 0, ..SlaveConfig::default() };
    let config = TdmaConfig { slots: Vec::new(), address: own, ..config(RoleConfig::Slave(follow)) };
    let mut station = Tdma::new(&config).unwrap();
    core::mem::swap(&mut station.role, role);
    core::mem::swap(&mut station.events, events);
    let done = act(&mut station);
    core::mem::swap(&mut station.role, role);
    core::mem::swap(&mut station.events, events);
    done
}

/// By a command it is something else from now on: what that is, and what it was.
pub fn become_it(station: &mut Tdma, now: Instant, role: NewRole) -> (RoleName, Role) {
    let mut command = TdmaCommand::Become(role);
    station.command(now, &mut command).unwrap();
    let TdmaCommand::Become(NewRole(before)) = command else { unreachable!("it is the command") };
    let became = station.status().role;
    let sync = Message::Sync { cycle: 1, xmit: GlobalTime::default(), sched: GlobalTime::default() };
    if became == RoleName::Detached {
        assert_eq!(hear_at(station, now, OTHER, sync), Err(Refusal::Detached), "it is deaf");
        assert!(station.next_deadline().is_none(), "and silent");
    }
    (became, before)
}

/// A frame for all.
pub fn hear_at(station: &mut Tdma, rx: Instant, from: Address, message: Message) -> Result<(), Refusal> {
    let mut frame = Pool::new(1).take().unwrap();
    message.write(Address::BROADCAST, from, &mut frame);
    match station.on_frame(Some(rx), frame) {
        Claimed::Kept => Ok(()),
        Claimed::Refused(reason) => Err(reason),
        Claimed::Tunnel(_) => unreachable!("it is no tunnel's"),
    }
}
