use rtnet::buf::Pool;
use rtnet::wire::ethernet::MIN_FRAME;

use super::*;
use crate::scenario::{Network, Source};

const MS: u64 = 1_000_000;

/// A ring of three, and what is on its medium.
struct Medium {
    judge: Judge,
    scenario: Scenario,
    now: True,
    token: Token,
}

impl Medium {
    /// The token is with the first.
    fn new() -> Self {
        let stations = ["a", "b", "c"].map(|name| format!("[[station]]\nname = \"{name}\"\n"));
        let text = format!("discipline = \"token\"\nrate = \"100M\"\n{}", stations.concat());
        let Ok(Network::Ring(ring)) = Source::new("ring.toml", &text).parse_any() else { panic!("a ring") };
        let token = Token {
            kind: Kind::Pass,
            size: 3,
            digest: ring.ring.digest(),
            generation: 1,
            sequence: 0,
            from: 2,
            to: 0,
            since: 0,
            invite: 0,
            present: 0b111,
        };
        let judge = Judge::new(ring.ring.clone(), &ring.network, &[EmulatedClock::default(); 3]);
        let mut medium = Self { judge, scenario: ring.network, now: MS, token };
        medium.sends(token);
        medium.judge.begin();
        medium
    }

    fn airs(&mut self, from: usize, ether_type: [u8; 2]) {
        let mut bytes = [0; MIN_FRAME];
        bytes[6..12].copy_from_slice(&self.scenario.address(from).0);
        bytes[12..14].copy_from_slice(&ether_type);
        bytes[14..16].copy_from_slice(&(from as u16).to_be_bytes());
        self.judge.frame(self.now, &bytes);
    }

    fn sends(&mut self, token: Token) {
        let mut frame = Pool::new(1).take().unwrap();
        token.write(self.scenario.address(token.from.into()), &mut frame);
        self.judge.frame(self.now, &frame);
        self.token = token;
        self.now += MS;
    }

    /// Who has it passes it on.
    fn passes(&mut self) {
        let Token { sequence, to, .. } = self.token;
        self.sends(Token { sequence: sequence + 1, from: to, to: (to + 1) % 3, ..self.token });
    }

    /// Twice sent to the next, who is dead, then to the one behind.
    fn skips(&mut self) {
        let Token { sequence, to, from, present, .. } = self.token;
        self.sends(self.token);
        let to_next = Token { sequence: sequence + 1, to: (to + 1) % 3, from, ..self.token };
        self.sends(Token { present: present & !(1 << to), ..to_next });
    }

    fn finish(self) -> Judged {
        self.judge.finish(self.now)
    }
}

#[test]
fn rounds_are_from_token_to_token_and_nothing_is_wrong_with_them() {
    let mut medium = Medium::new();
    (0..7).for_each(|_| medium.passes());
    let judged = medium.finish();
    assert_eq!((judged.tokens.passed, judged.unexplained, judged.overlaps), (7, 0, 0));
    let visits: Vec<u64> = judged.seats.iter().map(|seat| seat.visits).collect();
    assert_eq!(visits, [2, 3, 2]);
    assert_eq!(judged.undisturbed.unwrap().0, Span::from_millis(3));
    assert!(judged.recoveries.is_empty());
}

#[test]
fn a_value_is_under_way_until_its_stations_next_frame_or_if_that_is_lost_until_the_one_after() {
    let mut medium = Medium::new();
    for _ in 0..7 {
        medium.airs(medium.token.to.into(), [0x88, 0xb5]);
        medium.passes();
    }
    let judged = medium.finish();
    let air = medium_air();
    let seen = |seat: &Seat| (seat.frames, seat.octets, seat.delivery.len(), seat.delivery_with_a_loss.n);
    let octets = (MIN_FRAME - HEADER_LEN) as u64;
    let of = |frames| (frames, frames * octets, frames - 1, frames - 2);
    assert_eq!(judged.seats.iter().map(seen).collect::<Vec<_>>(), [of(3), of(2), of(2)]);
    let first = &judged.seats[0];
    // A histogram is right to a thousandth.
    assert!(
        (first.delivery.max() - (3 * MS as i64 + air.nanos())).abs() <= 3_007,
        "{}",
        first.delivery.max()
    );
    assert_eq!(first.delivery_with_a_loss.span, Some(Span::from_millis(6) + air));
}

/// Of the shortest frame at 100 Mbit/s, with all that is around it.
fn medium_air() -> Span {
    Span::from_nanos((MIN_FRAME as i64 + 24) * 80)
}

#[test]
fn a_token_that_is_lost_for_no_reason_is_unexplained_and_takes_until_the_next_frame() {
    let mut medium = Medium::new();
    medium.passes();
    medium.skips();
    medium.passes();
    let judged = medium.finish();
    let [recovery] = &judged.recoveries[..] else { panic!("one: {:?}", judged.recoveries) };
    assert_eq!((recovery.took(), &recovery.victims[..], recovery.sends), (Span::from_millis(3), &[1][..], 2));
    assert_eq!((judged.unexplained, recovery.cause), (1, "unexplained"));
    assert_eq!((judged.tokens.repeated, judged.tokens.skipped), (1, 1));
    assert!(!judged.is_lost);
}

#[test]
fn a_token_that_is_lost_at_the_end_is_a_gap() {
    let mut medium = Medium::new();
    medium.passes();
    medium.skips();
    let judged = medium.finish();
    assert_eq!((judged.recoveries.len(), judged.is_lost), (1, true));
}

#[test]
fn it_is_explained_by_what_happens_or_by_what_its_station_tells_once() {
    let mut medium = Medium::new();
    medium.judge.happens(2 * MS, 2 * MS);
    medium.skips();
    medium.passes();
    assert_eq!(medium.finish().causes, BTreeMap::from([("event".into(), 1)]));

    let mut medium = Medium::new();
    for _ in 0..2 {
        medium.passes();
        medium.sends(medium.token);
    }
    // The second was told of, the first was not.
    medium.judge.told(2, EventKind::TokenOverdue);
    medium.judge.told(2, EventKind::TokenRepeated);
    medium.passes();
    let judged = medium.finish();
    assert_eq!((judged.causes, judged.unexplained), (BTreeMap::from([("late_host".into(), 1)]), 1));
}

#[test]
fn one_that_is_claimed_is_back_with_the_first_frame_of_who_claimed_it() {
    let mut medium = Medium::new();
    medium.passes();
    let claim = Token { kind: Kind::Claim, generation: 2, sequence: 0, from: 0, to: 0, ..medium.token };
    medium.sends(claim);
    medium.airs(1, [0x88, 0xb5]);
    assert!(medium.judge.recoveries.is_empty(), "of another");
    medium.airs(0, [0x88, 0xb5]);
    let judged = medium.finish();
    assert_eq!((judged.tokens.claimed, judged.recoveries.len()), (1, 1));
    assert_eq!(judged.recoveries[0].victims, [1]);
}

#[test]
fn a_second_token_is_void_and_two_frames_at_once_are_seen_and_not_explained_by_nothing() {
    let mut medium = Medium::new();
    medium.passes();
    let older = Token { sequence: medium.token.sequence - 1, from: 0, to: 2, ..medium.token };
    medium.passes();
    medium.sends(older);
    let judged = medium.finish();
    assert_eq!((judged.tokens.void, judged.unexplained), (1, 1));

    let mut medium = Medium::new();
    medium.airs(0, [0x88, 0xb5]);
    medium.now += 100;
    medium.airs(0, [0x88, 0xb5]);
    assert_eq!(medium.judge.overlaps_in_all, 0, "a station does not meet itself");
    medium.airs(1, [0x88, 0xb5]);
    let judged = medium.finish();
    assert_eq!((judged.overlaps, judged.unexplained), (1, 1));
}

#[test]
fn who_is_invited_in_vain_costs_nothing_but_that() {
    let mut medium = Medium::new();
    medium.judge.happens(MS, MS);
    medium.skips();
    let recoveries = medium.judge.recoveries.len();
    medium.passes();
    let Token { sequence, to, .. } = medium.token;
    // Back to the absent one, and on behind it.
    medium.sends(Token { sequence: sequence + 1, from: to, to: 0, present: 0b111, ..medium.token });
    let Token { sequence, from, .. } = medium.token;
    medium.sends(Token { sequence: sequence + 1, from, to: 1, present: 0b110, ..medium.token });
    medium.passes();
    let judged = medium.finish();
    assert_eq!((judged.tokens.invitations, judged.recoveries.len(), recoveries), (1, 1, 0));
    assert_eq!(judged.seats[0].visits, 0);
}
