//! Components that are killed at any instruction, beside others that go on.

use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use package_router::mailbox::of_owner;

use super::*;

/// Set for a process that is to be a component which is killed: of which station, and which one it is.
const VICTIM_OF: &str = "RTNET_VICTIM_OF";
/// Components that are killed, unless RTNET_VICTIMS says otherwise.
const KILLS: u64 = 40;
const TEST: &str = "killed::components_that_are_killed_lose_their_own_packages_and_nobody_elses";
/// Where victims send to, and what they read.
const SINK: MailboxName = MailboxName(0x0090_0000);
const VICTIM: MailboxName = MailboxName(0x00a0_0000);

/// A package of a victim: whose, which one, and both again over all of it.
fn body(victim: u64, count: u64) -> [u8; 48] {
    let mut body = [0; 48];
    body.chunks_mut(16).for_each(|part| {
        part[..8].copy_from_slice(&victim.to_ne_bytes());
        part[8..].copy_from_slice(&count.to_ne_bytes());
    });
    body
}

/// Sends and receives, to itself and others, as fast as it can, until it is killed.
fn be_a_victim(station: &str, number: u64) -> ! {
    let component = Component::attach(Path::new(station)).unwrap();
    let mut mailbox = component.mailbox(VICTIM, Shape::new(4, 48).replacing()).unwrap();
    let (mut to_sink, mut to_itself) = (mailbox.sender(SINK).unwrap(), mailbox.sender(VICTIM).unwrap());
    for count in 1.. {
        let _ = to_sink.send(1, &body(number, count));
        let _ = to_itself.send(1, &body(number, count));
        if count % 3 == 0 {
            let _ = mailbox.try_receive();
        }
        if count % 64 == 0 {
            let _ = mailbox.receive(Some(Duration::from_micros(50)));
            drop(to_itself);
            // The owner of that lane is this component: it says that all is read when it looks.
            let _ = mailbox.clean();
            to_itself = bound(&mailbox, VICTIM);
        }
    }
    unreachable!()
}

fn victim(station: &Station, number: u64) -> Child {
    let own = std::env::current_exe().unwrap();
    let of = format!("{} {number}", station.path.display());
    let mut command = Command::new(own);
    command.args(["--exact", TEST, "--nocapture"]).env(VICTIM_OF, of);
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

#[test]
fn components_that_are_killed_lose_their_own_packages_and_nobody_elses() {
    if let Ok(victim) = std::env::var(VICTIM_OF) {
        let (station, number) = victim.rsplit_once(' ').unwrap();
        be_a_victim(station, number.parse().unwrap());
    }
    let kills = std::env::var("RTNET_VICTIMS").map_or(KILLS, |kills| kills.parse().unwrap());
    let station = Station::new();
    let (_sink, mut sink) = component(&station.path, SINK, Shape::new(8, 48).senders(3));
    let (_ask, mut ask) = component(&station.path, name(0x10, 0), Shape::new(4, 48));
    let mut to_sink = ask.sender(SINK).unwrap();
    let mut to_itself = ask.sender(ask.name()).unwrap();
    let (mut of_victims, mut of_us, mut trips) = (0u64, 0u64, 0u64);
    // Others go on: each package of theirs comes.
    let mut go_on = |last: &mut (u64, u64)| {
        to_sink.send(2, &body(0, trips)).unwrap();
        to_itself.send(2, &body(0, trips)).unwrap();
        assert_eq!(ask.receive(Some(PATIENCE)).unwrap().body().to_vec(), body(0, trips));
        trips += 1;
        while let Some(package) = sink.try_receive().unwrap() {
            let bytes = package.body().to_vec();
            let [victim, count] = [0, 8].map(|at| u64::from_ne_bytes(bytes[at..at + 8].try_into().unwrap()));
            assert_eq!(bytes, body(victim, count), "torn");
            if package.head().from == VICTIM {
                of_victims += 1;
                // Those of one come in their order; of the next none before the last one's lane was read to its end.
                assert!((victim, count) > *last, "{victim} {count} behind {last:?}");
                *last = (victim, count);
            } else {
                assert_eq!((package.head().from, count), (name(0x10, 0), of_us));
                of_us += 1;
            }
        }
    };
    let mut last = (0, 0);
    let mut silent = 0;
    for number in 1..=kills {
        let mut victim = victim(&station, number);
        let deadline = Instant::now() + PATIENCE;
        while last.0 != number {
            assert!(Instant::now() < deadline, "{number} sends nothing: {:?}", victim.try_wait());
            go_on(&mut last);
        }
        // It is in the middle of it: at which moment, chance says.
        let until = Instant::now() + Duration::from_micros(number * 7_919 % 3_000);
        while Instant::now() < until {
            go_on(&mut last);
        }
        assert_eq!(victim.try_wait().unwrap(), None, "{number}: it still runs");
        victim.kill().unwrap();
        assert_eq!(victim.wait().unwrap().signal(), Some(9));
        let before = last;
        go_on(&mut last);
        silent += u64::from(before == last);
    }
    let deadline = Instant::now() + PATIENCE;
    while of_us_is_behind(&mut sink, &mut of_us, trips) {
        assert!(Instant::now() < deadline, "{of_us} of {trips} came");
    }
    assert_eq!((sink.counted(of_owner::FORGED), sink.counted(of_owner::NONSENSE)), (0, 0));
    // The name is free, and so are its lanes.
    let (_heir, heir) = component(&station.path, VICTIM, Shape::new(1, 48));
    for _ in 0..2 {
        sink.depth().unwrap();
        drop(bound(&heir, SINK));
    }
    println!(
        "FIGURE {}: {kills} components killed; of theirs {of_victims} packages came, all whole and in order, after {silent} of \
         them nothing more; of another's {trips} round trips and as many packages none was lost",
        TEST.trim_start_matches("killed::")
    );
}

/// What is left of ours.
fn of_us_is_behind(sink: &mut Mailbox, of_us: &mut u64, trips: u64) -> bool {
    while let Some(package) = sink.try_receive().unwrap() {
        *of_us += u64::from(package.head().from == name(0x10, 0));
    }
    *of_us < trips
}
