use super::*;
use proptest::collection::vec;
use proptest::prelude::*;

const NAME: MailboxName = MailboxName(0x0012_0103);
const SHAPE: Shape = Shape::new(7, 240).senders(3).replacing();
const LANE: Lane = Lane { place: 255, lane: 127, mailbox: u64::MAX, generation: 7 };

#[test]
fn what_is_asked_and_answered_comes_over_as_it_is() {
    let bind = Ask::Bind { from: NAME, to: MailboxName(9) };
    let (pattern, station) = ("0.Pilot.*".parse().unwrap(), [10, 0, 0, 9].into());
    let routes = [
        Ask::Look(3),
        Ask::RouteAt(255),
        Ask::AddRoute(pattern, station),
        Ask::DeleteRoute(pattern),
        Ask::Way(NAME),
    ];
    for ask in routes {
        assert_eq!(Ask::parse(&ask.to_bytes()), Some(ask));
    }
    let create = Ask::Create(NAME, SHAPE);
    let answering = Ask::Create(NAME, SHAPE.answering());
    for ask in [Ask::Attach, create, answering, Ask::Delete(NAME), bind, Ask::Ready(LANE), Ask::Unbind(LANE)]
    {
        assert_eq!(Ask::parse(&ask.to_bytes()), Some(ask));
    }
    let refused = [
        Refused::Taken(NAME),
        Refused::NoName(MailboxName::NOBODY),
        Refused::TooMany,
        Refused::NoMailbox(NAME),
        Refused::NotOwn(NAME),
        Refused::NoLane(NAME, 16),
        Refused::Shape(ShapeError::Slots(0)),
        Refused::Shape(ShapeError::Body(usize::MAX)),
        Refused::Shape(ShapeError::Senders(500)),
        Refused::Shape(ShapeError::Memory(1, 2, 3)),
        Refused::Shape(ShapeError::Answers),
    ];
    let created = Answer::Created { place: 3, generation: u64::MAX };
    let [here, beyond] =
        [false, true].map(|is_tcp| Answer::Reserved { lane: LANE, shape: SHAPE, priority: 255, is_tcp });
    let mailbox = Answer::Mailbox { place: 9, name: NAME, shape: SHAPE, process: u32::MAX };
    let away = Answer::Away { station: [10, 0, 0, 9].into(), priority: 7, channel: 5 };
    for answer in [
        Answer::Done,
        Answer::Failed(-7),
        created,
        here,
        beyond,
        away,
        mailbox,
        Answer::Route(pattern, station),
        Answer::NoMore,
        Answer::ByTcp { is_of_other_system: false },
        Answer::ByTcp { is_of_other_system: true },
    ]
    .into_iter()
    .chain(refused.map(Answer::Refused))
    {
        assert_eq!(Answer::parse(&answer.to_bytes()), Some(answer));
    }
}

proptest! {
    #[test]
    fn any_packet_is_read_or_refused(packet in vec(any::<u8>(), 0..ANSWER_LEN + 2), is_ours in any::<bool>(), len in 0..3usize) {
        let mut packet = packet;
        packet.resize([packet.len(), ASK_LEN, ANSWER_LEN][len], 0);
        if is_ours && packet.len() >= 4 {
            packet[..4].copy_from_slice(&MAGIC);
        }
        let _ = (Ask::parse(&packet), Answer::parse(&packet));
    }
}
