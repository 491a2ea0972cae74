//! What stations tell each other when the schedule changes while it runs: extensions, which real RTnet stations drop for
//! their version. All fields big-endian.
//!
//! ```text
//! behind a Synchronisation's fields, in what is padding else, up to byte 60:
//! 42        44        46            50             54              58      59      60
//! +---------+---------+-------------+--------------+---------------+-------+-------+
//! | version | message | oper        | admin        | activation    | state | check |   Status, from the acting master
//! | 0x8201  | 0x0100  | number, sum | number, sum  | cycle         |       |       |
//! +---------+---------+-------------+--------------+---------------+-------+-------+
//!
//! frames of their own, behind RTmac's header, type TDMA:
//! 18        20        22
//! +---------+---------+--------------------------------------------------------------------------------+
//! | version | message | Part   (0x0101): number 2, slots 2, index 2, sum 2, digest 8, cycle 8, latest 4,      |
//! | 0x8201  |         |                  station 6, slot 1, joint 1, size 2, phase 4, period 4, offset 8      |
//! |         |         | Answer (0x0110): number 2, sum 2, digest 8, what 1, reason 1, slot 1, flags 1         |
//! +---------+---------+--------------------------------------------------------------------------------+
//! ```
//!
//! `oper` is the schedule that is in use, `admin` the one that is proposed; bit 7 of `state` is set where whoever says it is
//! not sure of it. A status lies where real stations' frames have
//! stale memory: the check is over the whole frame, whose cycle number differs from any old one's.

use rtnet::buf::Buf;
use rtnet::counters::Refusal;
use rtnet::time::Span;
use rtnet::wire::ethernet::{self, Address, EtherType};
use zerocopy::byteorder::network_endian::{U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::{BODY, Head, RTMAC_VERSION, SyncBody, TYPE_TDMA, TdmaHead, prefix, put};
use crate::tdma::SlotConfig;

/// TDMA's version in extensions.
pub const EXTENSION_VERSION: u16 = 0x8201;
const ID_STATUS: u16 = 0x0100;
const ID_PART: u16 = 0x0101;
const ID_ANSWER: u16 = 0x0110;

/// Where a status begins in a Synchronisation.
const STATUS_AT: usize = BODY + size_of::<SyncBody>();
/// A slot that takes from its own queue.
const NOT_JOINT: u8 = 0xff;
/// A state's flag: who says it is not sure of it.
const UNSURE: u8 = 0x80;
/// An answer's flag: who sends it may give the time.
const GIVES_TIME: u8 = 0x01;

/// Which schedule: a change's number and what its content sums up to. 0 and 0: what every station was started with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, PartialOrd, Ord)]
pub struct ScheduleId {
    /// Counts changes, from 1.
    pub number: u16,
    /// Of its content, so that two of one number are told apart.
    pub sum: u16,
}

/// How far a change is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum State {
    /// Nothing is pending.
    Idle = 0,
    /// Stations are asked for an answer.
    Proposed = 1,
    /// All have acknowledged; who may give the time is asked to confirm the activation cycle.
    Committed = 2,
    /// All of those have: it will be switched.
    Sealed = 3,
    /// The new schedule is in use since the activation cycle.
    Switched = 4,
    /// The proposed one is withdrawn; whatever activation cycle was named, nobody switches in it.
    Cancelled = 5,
}

/// What the acting master says with every Synchronisation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Status {
    /// The schedule in use.
    pub oper: ScheduleId,
    /// The one that is proposed, or was last.
    pub admin: ScheduleId,
    /// The cycle from which on `admin` is to be used, or `oper` is.
    pub activation: u32,
    /// How far it is.
    pub state: State,
    /// Whether whoever says this knows it. Who was away while others may have decided does not: nobody sends then.
    pub is_sure: bool,
}

/// One slot of a schedule, and what is said of the whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// Which schedule.
    pub id: ScheduleId,
    /// Over the whole schedule.
    pub digest: u64,
    /// How many slots it has.
    pub slots: u16,
    /// Which this is, from 0.
    pub index: u16,
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// Whose slot.
    pub station: Address,
    /// The slot; `latest` is one for all.
    pub slot: SlotConfig,
}

/// A station's answer to a proposal or a commit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer {
    /// Which schedule.
    pub id: ScheduleId,
    /// Over the whole schedule, as it has come.
    pub digest: u64,
    /// What it says.
    pub verdict: Verdict,
    /// Whether it may give the time itself.
    pub gives_time: bool,
}

/// What a station says to a schedule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It can do it, and has all of it.
    Acknowledged,
    /// It knows the activation cycle.
    Confirmed,
    /// It cannot.
    Refused(Why, u8),
}

/// Why a station cannot take a schedule. With each goes the slot that it is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Why {
    /// The id is beyond what the station has room for.
    SlotId = 1,
    /// No frame has such a payload.
    Size = 2,
    /// A phase outside its period.
    Phase = 3,
    /// Two slots with one id.
    Twice = 4,
    /// There is no slot of that size to be joined to.
    Joint = 5,
    /// It begins outside the cycle.
    Offset = 6,
    /// It begins before the station, as it follows or takes over, could use it.
    TooEarly = 7,
    /// No slave follows such a cycle, or this master cannot give it.
    Cycle = 8,
    /// The station measures its delay just now.
    Calibrating = 9,
    /// It bridges more cycles than a change waits for.
    Holdover = 10,
    /// It could not calibrate with these slots.
    NeverCalibrated = 11,
}

impl Why {
    /// Every reason.
    pub const ALL: [Why; 11] = [
        Why::SlotId,
        Why::Size,
        Why::Phase,
        Why::Twice,
        Why::Joint,
        Why::Offset,
        Why::TooEarly,
        Why::Cycle,
        Why::Calibrating,
        Why::Holdover,
        Why::NeverCalibrated,
    ];

    /// What to tell a user, behind the station's and the slot's name.
    pub const fn text(self) -> &'static str {
        match self {
            Why::SlotId => "its id is beyond the highest of that station (max_slot_id)",
            Why::Size => "its size is no frame's payload",
            Why::Phase => "its phase is outside its period",
            Why::Twice => "it is there twice",
            Why::Joint => "what it is joined to is not there, is joined itself, or has another size",
            Why::Offset => "it begins outside the cycle",
            Why::TooEarly => {
                "it begins too early for that station: before a Synchronisation, or its own as a backup, can be there"
            }
            Why::Cycle => "that station cannot give, or follow, a cycle of this length",
            Why::Calibrating => "that station measures its delay just now: propose again when it is done",
            Why::Holdover => "that station bridges more cycles than a change allows",
            Why::NeverCalibrated => {
                "that station calibrates in its first slot, for which it comes too seldom"
            }
        }
    }
}

/// An extension's frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extension {
    /// From the acting master to all.
    Part(Part),
    /// From a station to the acting master.
    Answer(Answer),
}

#[derive(Clone, Copy, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct IdField {
    number: U16,
    sum: U16,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct StatusBody {
    head: TdmaHead,
    oper: IdField,
    admin: IdField,
    activation: U32,
    state: u8,
    check: u8,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct PartBody {
    number: U16,
    slots: U16,
    index: U16,
    sum: U16,
    digest: U64,
    cycle: U64,
    latest: U32,
    station: [u8; 6],
    slot: u8,
    joint: u8,
    size: U16,
    phase: U32,
    period: U32,
    offset: U64,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct AnswerBody {
    id: IdField,
    digest: U64,
    what: u8,
    reason: u8,
    slot: u8,
    flags: u8,
}

/// Bytes of the longest extension frame: what has to fit behind a Synchronisation.
pub const PART_LEN: usize = BODY + size_of::<PartBody>();
const _: () = assert!(STATUS_AT + size_of::<StatusBody>() == ethernet::MIN_FRAME);
const _: () = assert!(PART_LEN == 76);
const _: () = assert!(BODY + size_of::<AnswerBody>() <= ethernet::MIN_FRAME);

const ACKNOWLEDGED: u8 = 1;
const CONFIRMED: u8 = 2;
const REFUSED: u8 = 3;

impl From<ScheduleId> for IdField {
    fn from(id: ScheduleId) -> Self {
        Self { number: U16::new(id.number), sum: U16::new(id.sum) }
    }
}

impl From<IdField> for ScheduleId {
    fn from(id: IdField) -> Self {
        Self { number: id.number.get(), sum: id.sum.get() }
    }
}

impl State {
    const ALL: [State; 6] =
        [State::Idle, State::Proposed, State::Committed, State::Sealed, State::Switched, State::Cancelled];

    /// The state's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            State::Idle => "idle",
            State::Proposed => "proposed",
            State::Committed => "committed",
            State::Sealed => "sealed",
            State::Switched => "switched",
            State::Cancelled => "cancelled",
        }
    }
}

impl Status {
    /// Writes it behind the fields of a Synchronisation that is already in `frame`.
    pub fn write(&self, frame: &mut Buf) {
        let Status { oper, admin, activation, state, is_sure } = *self;
        let head = TdmaHead { version: U16::new(EXTENSION_VERSION), message: U16::new(ID_STATUS) };
        let (oper, admin, activation) = (oper.into(), admin.into(), U32::new(activation));
        let state = state as u8 | if is_sure { 0 } else { UNSURE };
        let body = StatusBody { head, oper, admin, activation, state, check: 0 };
        let room = frame.room_mut();
        let end = put(room, STATUS_AT, &body);
        room[end - 1] = check(&room[..end]);
    }

    /// What a Synchronisation says of schedules; `None`: nothing, as real stations' do.
    pub fn of_sync(frame: &[u8]) -> Option<Self> {
        let (body, _) = StatusBody::ref_from_prefix(frame.get(STATUS_AT..)?).ok()?;
        let is_one = (body.head.version.get(), body.head.message.get()) == (EXTENSION_VERSION, ID_STATUS);
        let state = State::ALL.into_iter().find(|&state| state as u8 == body.state & !UNSURE)?;
        let end = STATUS_AT + size_of::<StatusBody>();
        if !is_one || check(&frame[..end]) != body.check {
            return None;
        }
        let (oper, admin, activation) = (body.oper.into(), body.admin.into(), body.activation.get());
        Some(Status { oper, admin, activation, state, is_sure: body.state & UNSURE == 0 })
    }
}

/// Over the cycle number and a status, without its last byte: eight bits of FNV-1a. The stamps before it are written later.
fn check(frame: &[u8]) -> u8 {
    let cycle = &frame[BODY..BODY + size_of::<u32>()];
    let said = &frame[STATUS_AT..frame.len() - 1];
    let hash =
        cycle.iter().chain(said).fold(0x811c_9dc5u32, |h, &b| (h ^ u32::from(b)).wrapping_mul(0x0100_0193));
    (hash ^ hash >> 8 ^ hash >> 16 ^ hash >> 24) as u8
}

/// Reads what is behind RTmac's header of an extension. The caller has checked the version.
pub(super) fn parse(message: u16, body: &[u8]) -> Result<Extension, Refusal> {
    match message {
        ID_PART => prefix::<PartBody>(body).and_then(|(b, _)| part(b)).map(Extension::Part),
        ID_ANSWER => prefix::<AnswerBody>(body).and_then(|(b, _)| answer(b)).map(Extension::Answer),
        _ => Err(Refusal::TdmaMessage),
    }
}

fn part(b: &PartBody) -> Result<Part, Refusal> {
    let span = |nanos: u64| i64::try_from(nanos).map(Span::from_nanos).map_err(|_| Refusal::ScheduleFormat);
    if b.index.get() >= b.slots.get() {
        return Err(Refusal::ScheduleFormat);
    }
    Ok(Part {
        id: ScheduleId { number: b.number.get(), sum: b.sum.get() },
        digest: b.digest.get(),
        slots: b.slots.get(),
        index: b.index.get(),
        cycle: span(b.cycle.get())?,
        station: Address(b.station),
        slot: SlotConfig {
            id: b.slot,
            offset: span(b.offset.get())?,
            phase: b.phase.get(),
            period: b.period.get(),
            size: b.size.get().into(),
            joint: (b.joint != NOT_JOINT).then_some(b.joint),
            latest: Span::from_nanos(b.latest.get().into()),
        },
    })
}

fn answer(b: &AnswerBody) -> Result<Answer, Refusal> {
    let verdict = match b.what {
        ACKNOWLEDGED => Verdict::Acknowledged,
        CONFIRMED => Verdict::Confirmed,
        REFUSED => {
            let why = Why::ALL.into_iter().find(|&why| why as u8 == b.reason);
            Verdict::Refused(why.ok_or(Refusal::ScheduleFormat)?, b.slot)
        }
        _ => return Err(Refusal::ScheduleFormat),
    };
    Ok(Answer { id: b.id.into(), digest: b.digest.get(), verdict, gives_time: b.flags & GIVES_TIME != 0 })
}

impl Extension {
    /// Writes the whole frame, padded with zeros to the Ethernet minimum.
    pub fn write(&self, destination: Address, source: Address, frame: &mut Buf) {
        let ethernet = ethernet::Header::new(destination, source, EtherType::RTMAC);
        let head = Head { kind: U16::new(TYPE_TDMA), version: RTMAC_VERSION, flags: 0 };
        let extension = |id| TdmaHead { version: U16::new(EXTENSION_VERSION), message: U16::new(id) };
        let room = frame.room_mut();
        let mut len = put(room, 0, &ethernet);
        len = put(room, len, &head);
        len = match self {
            Extension::Part(part) => {
                len = put(room, len, &extension(ID_PART));
                put(room, len, &part.body())
            }
            Extension::Answer(answer) => {
                len = put(room, len, &extension(ID_ANSWER));
                put(room, len, &answer.body())
            }
        };
        frame.set_len(len);
        frame.pad_to(ethernet::MIN_FRAME);
    }
}

impl Part {
    fn body(&self) -> PartBody {
        let SlotConfig { id, offset, phase, period, size, joint, latest } = self.slot;
        PartBody {
            number: U16::new(self.id.number),
            slots: U16::new(self.slots),
            index: U16::new(self.index),
            sum: U16::new(self.id.sum),
            digest: U64::new(self.digest),
            cycle: U64::new(self.cycle.nanos() as u64),
            latest: U32::new(latest.nanos() as u32),
            station: self.station.0,
            slot: id,
            joint: joint.unwrap_or(NOT_JOINT),
            size: U16::new(size as u16),
            phase: U32::new(phase),
            period: U32::new(period),
            offset: U64::new(offset.nanos() as u64),
        }
    }
}

impl Answer {
    fn body(&self) -> AnswerBody {
        let (what, reason, slot) = match self.verdict {
            Verdict::Acknowledged => (ACKNOWLEDGED, 0, 0),
            Verdict::Confirmed => (CONFIRMED, 0, 0),
            Verdict::Refused(why, slot) => (REFUSED, why as u8, slot),
        };
        let (id, digest) = (self.id.into(), U64::new(self.digest));
        AnswerBody { id, digest, what, reason, slot, flags: if self.gives_time { GIVES_TIME } else { 0 } }
    }
}

#[cfg(test)]
mod tests;
