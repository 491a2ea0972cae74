//! How things happen to a calibration.

use super::*;

impl Seat {
    pub(super) fn new(follow: SlaveConfig) -> Self {
        let latest = Span::from_micros(20);
        let offset = Span::from_micros(SLOT as i64);
        let slave = Tdma::new(&TdmaConfig {
            address: OWN,
            role: RoleConfig::Slave(follow),
            slots: vec![SlotConfig { id: 0, offset, phase: 0, period: 1, size: 100, joint: None, latest }],
            max_slot_id: DEFAULT_MAX_SLOT_ID,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        });
        Self { slave: slave.unwrap(), cycle: 0, asked: 0 }
    }

    pub(super) fn calibration(&self) -> &Calibration {
        match &self.slave.role {
            Role::Slave(slave) => slave.calibration(),
            _ => unreachable!("it is a slave"),
        }
    }

    pub(super) fn seen(&self) -> (State, Counts) {
        let calibration = self.calibration();
        let state = state_of(calibration).expect("none is ever so");
        (state, (calibration.room.samples.len(), calibration.attempts, calibration.repeats()))
    }

    /// Neither of the line nor of turns.
    pub(super) fn told_of_calibration(&mut self) -> Vec<EventKind> {
        let told = std::iter::from_fn(|| self.slave.next_event()).map(|event| event.kind);
        told.filter(|kind| {
            let of_the_line = matches!(kind, EventKind::TimeStep | EventKind::Holdover);
            let of_turns = matches!(kind, EventKind::SlotEmpty | EventKind::CalibrationTurn);
            !of_the_line && !of_turns
        })
        .collect()
    }

    fn hear(&mut self, from: Address, to: Address, rx: Instant, message: Message) -> Answer {
        let mut frame = Pool::new(1).take().unwrap();
        message.write(to, from, &mut frame);
        match self.slave.on_frame(Some(rx), frame) {
            Claimed::Kept => Answer::Kept,
            Claimed::Refused(reason) => Answer::Refused(reason),
            Claimed::Tunnel(_) => unreachable!("it is no tunnel's"),
        }
    }

    /// The next Synchronisation, so many microseconds beside the line.
    pub(super) fn hear_sync(&mut self, from: Address, beside: u64) -> Answer {
        self.cycle += 1;
        let start = at(u64::from(self.cycle) * 1_000 + beside);
        let sched = GlobalTime::from_nanos(start.nanos());
        let sync = Message::Sync { cycle: self.cycle, xmit: sched, sched };
        let answer = self.hear(from, Address::BROADCAST, start, sync);
        self.slave.on_timeout(start);
        answer
    }

    /// All rounds.
    pub(super) fn calibrate(&mut self) {
        for _ in 0..ROUNDS {
            self.ask(Happening::Sent);
            self.reply(0, 0);
        }
    }

    /// The turn of its slot, in which it has nothing to send.
    pub(super) fn pass_turn(&mut self) {
        assert!(self.slave.next_transmission(at(u64::from(self.cycle) * 1_000 + SLOT)).is_none());
    }

    pub(super) fn command(&mut self) -> Answer {
        let now = at(u64::from(self.cycle) * 1_000 + SLOT + 100);
        match self.slave.command(now, &mut TdmaCommand::Calibrate(NewRounds::of(ROUNDS).unwrap())) {
            Ok(_) => Answer::Begun,
            Err(refused) => {
                assert_eq!(refused, Refused::CalibratesAlready);
                Answer::Busy
            }
        }
    }

    /// Up to its next turn, with Synchronisations; where it follows nobody, there are none. Anew it asks in every fourth.
    pub(super) fn ask(&mut self, outcome: Happening) -> Answer {
        let cycles = if self.calibration().measures_anew() { 5 } else { 3 };
        for _ in 0..cycles {
            let now = at(u64::from(self.cycle) * 1_000 + SLOT);
            self.slave.on_timeout(now);
            if let Some(request) = self.slave.next_transmission(now) {
                let is_request =
                    matches!(wire::parse(&request.frame), Ok(Rtmac::Tdma(Message::Request { .. })));
                assert!(is_request, "there is nothing else to send");
                self.asked = now.nanos();
                let late = now + Span::from_micros(30);
                self.slave.on_sent(match outcome {
                    Happening::Stalled => Sent::StalledUntil(late),
                    Happening::Late => Sent::Late(late, request.frame),
                    Happening::Guarded => Sent::Guarded(late, request.frame),
                    Happening::Failed => Sent::Failed(105, request.frame),
                    _ => Sent::At(now),
                });
                return Answer::Asked;
            }
            if self.slave.time().state != SyncState::Waiting {
                self.hear_sync(MASTER, 0);
            }
        }
        Answer::Nothing
    }

    /// A reply to a request that left `other` nanoseconds later, received at the master's time `reception`.
    pub(super) fn reply(&mut self, other: u64, reception: u64) -> Answer {
        let request_xmit = self.asked + other;
        let calibration = self.calibration();
        let delays = if calibration.measures_anew() { DELAYS_ANEW } else { DELAYS };
        let delay = delays[calibration.room.samples.len().min(1)];
        let rx = Instant::from_nanos(self.asked) + Span::from_nanos(2 * delay);
        self.hear(MASTER, OWN, rx, Message::Reply { request_xmit, reception, xmit: 0 })
    }

    pub(super) fn meet(&mut self, happening: Happening) -> Answer {
        match happening {
            Happening::Sent
            | Happening::Stalled
            | Happening::Late
            | Happening::Guarded
            | Happening::Failed => self.ask(happening),
            Happening::Reply => self.reply(0, 0),
            Happening::ForeignReply => self.reply(1, 0),
            Happening::ImplausibleReply => self.reply(0, u64::MAX / 4),
            Happening::SyncLost => {
                self.slave.on_timeout(at(u64::from(self.cycle) * 1_000 + 2_500));
                Answer::Nothing
            }
            Happening::LineMoved => {
                self.hear_sync(MASTER, 300);
                self.hear_sync(MASTER, 300)
            }
            Happening::MasterChanged => self.hear_sync(BACKUP, 0),
            Happening::Command => self.command(),
        }
    }
}
