//! How a master gets to its places.

use super::*;

impl Place {
    /// `None` where this kind never is.
    pub(super) fn take(self, kind: Kind) -> Option<Seat> {
        let (backup, listens) = match kind {
            Kind::Primary => (None, 3),
            Kind::Backup => (Some(BACKUP), 50),
        };
        let mut bench = Bench::new(backup);
        let next = match (self, kind) {
            (Place::Attached, _) => 1,
            (Place::Listening, _) => {
                bench.wait_until(at(0));
                1
            }
            (Place::ListeningAgain, _) => {
                bench = Bench::following(backup, LATE);
                bench.wait_until(at(4_300));
                5
            }
            (Place::Unsure, _) => {
                bench.wait_until(at(0));
                bench.hear(LOWER, 1, LATE);
                2
            }
            (Place::FollowingPrimary, _) => {
                bench = Bench::following(backup, LATE);
                bench.hear(LOWER, 3, PROMPT);
                4
            }
            (Place::FollowingBackup, _) => {
                bench = Bench::following(backup, LATE);
                3
            }
            (Place::Calibrating, _) => {
                let follow = SlaveConfig { rounds: 1, ..SlaveConfig::default() };
                bench.master = Master::new(MasterConfig { follow, ..bench.master.config });
                bench.wait_until(at(500));
                bench.hear(LOWER, 1, LATE);
                bench.hear(LOWER, 2, LATE);
                3
            }
            (Place::Outlasted, Kind::Primary) => {
                bench = Bench::active(None);
                for cycle in 4..7 {
                    bench.send(true);
                    bench.hear(LOWER, cycle, PROMPT);
                }
                bench.hear(LOWER, 7, LATE);
                bench.hear(LOWER, 8, LATE);
                9
            }
            (Place::StandBy, Kind::Backup) => {
                bench = Bench::stand_by();
                3
            }
            (Place::Active, _) => {
                bench = Bench::active(backup);
                bench.send(true);
                listens + 1
            }
            (Place::BesideRival, Kind::Primary) => {
                bench = Bench::active(None);
                for cycle in 4..6 {
                    bench.send(true);
                    bench.hear(LOWER, cycle, PROMPT);
                }
                bench.send(true);
                6
            }
            (Place::BesideHigher, Kind::Primary) => {
                bench = Bench::active(None);
                for cycle in 4..13 {
                    bench.send(true);
                    bench.hear(HIGHER, cycle, PROMPT);
                }
                bench.send(true);
                13
            }
            (Place::Yielded, Kind::Primary) => {
                bench.hear(LOWER, 1, PROMPT);
                2
            }
            (Place::StandBy, Kind::Primary) => return None,
            (Place::Outlasted | Place::BesideRival | Place::BesideHigher | Place::Yielded, Kind::Backup) => {
                return None;
            }
        };
        assert_eq!(state_of(&bench.master.phase), self.state(), "{self:?}");
        assert_eq!(bench.master.mastery(), self.mastery(), "{self:?}");
        bench.told();
        Some(Seat { bench, next })
    }

    pub(super) fn state(self) -> State {
        match self {
            Place::Attached => State::Attached,
            Place::Listening | Place::ListeningAgain => State::Listening,
            Place::Unsure
            | Place::FollowingPrimary
            | Place::FollowingBackup
            | Place::Calibrating
            | Place::Outlasted => State::Following,
            Place::StandBy => State::StandBy,
            Place::Active | Place::BesideRival | Place::BesideHigher => State::Active,
            Place::Yielded => State::Yielded,
        }
    }

    pub(super) fn mastery(self) -> Mastery {
        match self.state() {
            State::Attached | State::Listening => Mastery::Listening,
            State::Following => Mastery::Following,
            State::StandBy => Mastery::StandBy,
            State::Active => Mastery::Active,
            State::Yielded => Mastery::Yielded,
        }
    }
}
