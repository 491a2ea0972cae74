//! How long anything takes at the most in a ring of the token discipline: pure arithmetic.
//!
//! All bounds hold as long as hosts are no later than [`RingConfig::late`] at each of their instants, a token takes no longer
//! than [`RingConfig::delay`], and clocks run apart by no more than 500 ppm. A host that is later loses its turn, and the
//! others take that for a loss: [`recovery_bound`].

use rtnet::time::Span;

use super::ring::{LONGEST_FRAME, RingConfig};

/// What a token frame that was lost, or a station that does not answer, costs each time: who passed it on waits for so long.
pub fn waits_for_one(ring: &RingConfig) -> Span {
    ring.time_out() + ring.late
}

/// From one arrival of the token at a station to the next, with so many stations that take part and so many that are absent.
/// Of these one is invited in a round, in vain if it is dead.
pub fn rotation_bound(ring: &RingConfig, present: usize, absent: usize) -> Span {
    one_after_another(ring, present) + invitation(ring, absent)
}

/// From when a frame is queued that is more urgent than all that wait, to when it is sent. At the worst the station has just
/// decided to pass the token on, behind its last frame, which is as long as frames are.
///
/// ```text
/// air of the longest frame + late + delay + (present - 1) x (visit + delay) + an invitation + gap + late
/// ```
pub fn access_delay_bound(ring: &RingConfig, present: usize, absent: usize) -> Span {
    let decided = ring.rate.air_time(LONGEST_FRAME) + ring.late + ring.delay;
    decided + one_after_another(ring, present.max(1) - 1) + invitation(ring, absent) + ring.gap() + ring.late
}

/// From when the token is lost to the next frame of data, if somebody has one: with so many stations dead one behind the other,
/// the holder among them, and so many token frames lost besides.
///
/// Either who passed it on is alive, and tries each of the dead twice; or it is not, and the last of the ring claims the token
/// after the silence.
pub fn recovery_bound(ring: &RingConfig, dead: usize, lost: usize) -> Span {
    let size = ring.stations.len() as i64;
    let sends = ring.gap() + ring.late;
    let skipped = waits_for_one(ring) * (2 * dead as i64) + ring.delay + sends;
    let silent = ring.delay + ring.silence() + ring.step() * (size - 1) + ring.late;
    let claimed = silent + ring.settle() + ring.late + sends;
    skipped.max(claimed) + waits_for_one(ring) * lost as i64
}

/// From when stations with a token each hear one another to when no more than one sends, if so many token frames are lost
/// meanwhile: the token that stays is heard of at least once in the time that one is waited for.
pub fn doubling_bound(ring: &RingConfig, lost: usize) -> Span {
    let heard = waits_for_one(ring) * (1 + lost as i64) + ring.delay;
    heard + ring.late + ring.rate.air_time(LONGEST_FRAME)
}

/// From when a station that is absent can be reached to when it has the token, with so many that take part, and so many that
/// are absent, itself among them; no token frame is lost.
pub fn rejoin_bound(ring: &RingConfig, present: usize, absent: usize) -> Span {
    let rounds = i64::from(ring.invite_every) + 2;
    rotation_bound(ring, present + absent, absent) * (rounds * absent as i64)
}

fn one_after_another(ring: &RingConfig, stations: usize) -> Span {
    (ring.visit() + ring.delay) * stations as i64
}

fn invitation(ring: &RingConfig, absent: usize) -> Span {
    if absent > 0 { waits_for_one(ring) } else { Span::ZERO }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::wire::ethernet::Address;

    /// Four stations at 100 Mbit/s: gap 6.72 us, hold 500 us, late 500 us, delay 100 us.
    fn usual() -> RingConfig {
        RingConfig::new((1..=4).map(|last| Address([2, 0, 0, 0, 0, last])).collect())
    }

    #[test]
    fn the_sums_are_those_of_the_specification() {
        let ring = usual();
        let ns = Span::from_nanos;
        assert_eq!(ring.visit(), ns(6_720 + 500_000 + 2 * 500_000));
        assert_eq!(ring.time_out(), ns(1_706_720 + 853 + 1));
        assert_eq!(rotation_bound(&ring, 4, 0), ns(4 * 1_606_720));
        assert_eq!(rotation_bound(&ring, 3, 1), ns(3 * 1_606_720 + 1_707_574 + 500_000));
        let air = 123_040;
        assert_eq!(access_delay_bound(&ring, 4, 0), ns(air + 600_000 + 3 * 1_606_720 + 6_720 + 500_000));
        assert_eq!(access_delay_bound(&ring, 1, 0), ns(air + 600_000 + 6_720 + 500_000));
        let silence = 3 * 2_207_574 + 3_311 + 1;
        let step = 700_000 + silence / 2_000;
        let claimed = 100_000 + silence + 3 * step + 500_000 + 700_000 + 500_000 + 6_720 + 500_000;
        assert_eq!(recovery_bound(&ring, 1, 0), ns(claimed));
        assert_eq!(recovery_bound(&ring, 1, 2), ns(claimed + 2 * 2_207_574));
        let skipped = 20 * 2_207_574 + 100_000 + 506_720;
        assert_eq!(recovery_bound(&ring, 10, 0), ns(skipped));
        assert_eq!(doubling_bound(&ring, 0), ns(2_207_574 + 100_000 + 500_000 + air));
        assert_eq!(rejoin_bound(&ring, 3, 1), rotation_bound(&ring, 4, 1) * 18);
    }
}
