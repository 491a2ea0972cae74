use super::*;
use rtmac::tdma::{Mastery, RoleName};
use rtnet::discipline::SyncState;

/// What a station answers that is this in the cycle.
fn status_of(role: RoleName, mastery: Option<Mastery>, state: SyncState) -> StationStatus {
    let arrived = serde_json::json!({ "received": 0, "missing": 0, "first": 0 });
    let mut standing = serde_json::json!({
        "at": 0, "state": state.name(), "settled": false, "link": "up", "master": false, "cycle": 7,
        "delay_ns": null, "yielded_to": null, "cpu_ns": 0, "frames_sent": 0, "arrived_queued": {}, "refusals": {},
        "clock_steps": 0, "lost_records": 0, "queue_refused": {},
    });
    standing.as_object_mut().unwrap().extend(arrived.as_object().unwrap().clone());
    let status = serde_json::json!({
        "name": "it", "pid": 1, "interface": "eth1", "address": "02:00:00:00:00:05", "link": "up",
        "discipline": "tdma", "role": role.name(), "guard": "user", "mastery": mastery.map(Mastery::name),
        "standing": standing, "period_ns": 1_000_000, "lead_ns": 50_000, "deviation_ns": 0, "drift_ppb": null, "clock": null,
        "slots": [], "counters": {}, "host": [], "misses": { "causes": {}, "worst": [], "latest": [] }, "control": {},
    });
    serde_json::from_value(status).unwrap()
}

#[test]
fn a_status_tells_role_and_state_and_of_masters_and_backups_what_they_are_doing() {
    use RoleName::{Backup, Detached, Master, Slave};
    use SyncState::{Calibrating, Holdover, Locked, Lost, Waiting};
    for (role, mastery, state, words) in [
        (Master, Some(Mastery::Listening), Waiting, "master (listening), waiting"),
        (Master, Some(Mastery::Following), Calibrating, "master (following), calibrating"),
        (Master, Some(Mastery::Active), Locked, "master (active), locked"),
        (Master, Some(Mastery::Yielded), Waiting, "master (yielded), waiting"),
        (Backup, Some(Mastery::StandBy), Locked, "backup (stand-by), locked"),
        (Backup, Some(Mastery::Active), Locked, "backup (active), locked"),
        (Slave, None, Holdover, "slave, holdover"),
        (Slave, None, Lost, "slave, lost"),
        (Detached, None, Waiting, "detached, waiting"),
    ] {
        let status = status_of(role, mastery, state);
        let text = describe(&status);
        assert!(text.starts_with(&format!("it: {words}, cycle 7 of 1ms\n")), "{text}");
        let json = serde_json::to_value(&status).unwrap();
        let told = [&json["role"], &json["mastery"], &json["standing"]["state"]];
        let told: Vec<_> = told.into_iter().filter_map(|word| word.as_str()).collect();
        assert_eq!(told.join(" "), words.replace(['(', ')', ','], ""));
    }
}

#[test]
fn slots_are_listed_with_how_long_a_frame_waits_for_the_next_of_its_queue_at_the_worst() {
    let slot = |id: u8, offset: i64, period: u32, joint: Option<u8>| {
        serde_json::json!({
            "id": id, "offset_ns": offset, "phase": 0, "period": period, "size": 1500, "joint": joint,
            "latest_ns": 20_000, "queued": 0, "sent": 0,
        })
    };
    let mut status = status_of(RoleName::Slave, None, SyncState::Locked);
    let shown = [slot(0, 100_000, 1, None), slot(2, 400_000, 1, Some(0)), slot(3, 700_000, 5, None)];
    status.slots = shown.map(|slot| serde_json::from_value(slot).unwrap()).to_vec();
    let waits = |status: &StationStatus| {
        let lines: Vec<_> = slots(status).lines().map(str::to_owned).collect();
        let place = lines[0].find("worst wait").unwrap() + "worst wait".len();
        lines[1..].iter().map(|line| line[..place].rsplit(' ').next().unwrap().to_owned()).collect::<Vec<_>>()
    };
    // A lead before the turn in which the frame comes too late, and from there to the next.
    assert_eq!(waits(&status), ["750us", "750us", "5.05ms"]);
    status.lead_ns = Some(200_000);
    assert_eq!(waits(&status), ["900us", "900us", "5.2ms"]);
    status.period_ns = None;
    assert_eq!(waits(&status), ["-"; 3]);
}
