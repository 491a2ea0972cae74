//! A mailbox, and what it is to be: a list for each sender, of which the most urgent is taken.

use super::*;

/// The seeds of a commit, as the tests of whole networks draw them: no package of this project is below this one.
#[path = "../../../../tests/src/seeds/drawn.rs"]
mod drawn;

/// What waits: lane, priority, when it was sent, its id, and its body.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Waiting {
    lane: usize,
    priority: u8,
    sent: u64,
    id: u8,
    body: Vec<u8>,
}

struct Model {
    slots: usize,
    largest_body: usize,
    when_full: WhenFull,
    waiting: Vec<Waiting>,
    replaced: u64,
}

impl Model {
    fn send(&mut self, package: Waiting) -> Result<(), SendError> {
        let got = package.body.len();
        if got > self.largest_body {
            return Err(SendError::TooLarge { got, most: self.largest_body });
        }
        let of_lane = self.waiting.iter().enumerate().filter(|(_, other)| other.lane == package.lane);
        if of_lane.clone().count() == self.slots {
            let least = of_lane
                .min_by_key(|(_, other)| (other.priority, other.sent))
                .map(|(place, _)| place)
                .unwrap();
            if self.when_full == WhenFull::Refuse || self.waiting[least].priority > package.priority {
                return Err(SendError::Full(self.slots));
            }
            self.waiting.remove(least);
            self.replaced += 1;
        }
        self.waiting.push(package);
        Ok(())
    }

    fn receive(&mut self) -> Option<Waiting> {
        let first =
            self.waiting.iter().enumerate().min_by_key(|(_, other)| (u8::MAX - other.priority, other.sent));
        let place = first.map(|(place, _)| place)?;
        Some(self.waiting.remove(place))
    }
}

/// Numbers by chance that repeat.
struct Dice(u64);

impl Dice {
    fn next(&mut self, below: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) % below
    }
}

fn course(shape: Shape, steps: u64, seed: u64) {
    let (mut inbox, mut senders) = mailbox(shape);
    let Shape { slots, largest_body, when_full, .. } = shape;
    let mut model = Model { slots, largest_body, when_full, waiting: Vec::new(), replaced: 0 };
    let mut dice = Dice(seed);
    for now in 1..=steps {
        match dice.next(16) {
            0..9 => {
                let lane = dice.next(shape.senders as u64) as usize;
                let priority = [0, 1, 100, 100, 254, 255][dice.next(6) as usize];
                let body = vec![now as u8; dice.next(largest_body as u64 + 2) as usize];
                let package = Waiting { lane, priority, sent: now, id: now as u8, body };
                let told =
                    senders[lane].send(&head(lane, priority, package.id), &package.body, &at(now)).map(drop);
                assert_eq!(told, model.send(package), "step {now}");
            }
            9..15 => {
                let came = inbox.receive(now).map(|package| Waiting {
                    lane: package.head().from.instance().into(),
                    priority: package.head().priority,
                    sent: package.stamps().sent,
                    id: package.head().id,
                    body: package.body().to_vec(),
                });
                assert_eq!(came, model.receive(), "step {now}");
            }
            _ if dice.next(20) == 0 => assert_eq!(inbox.clean(now), std::mem::take(&mut model.waiting).len()),
            _ => {
                assert_eq!(inbox.depth(), model.waiting.len(), "step {now}");
                if let Some(package) = inbox.receive(now) {
                    package.put_back();
                }
            }
        }
    }
    let replaced: u64 = senders.iter().map(|sender| sent(sender, of_sender::REPLACED)).sum();
    assert_eq!(replaced, model.replaced);
    assert_eq!((own(&inbox, of_owner::NONSENSE), own(&inbox, of_owner::FORGED)), (0, 0));
}

#[test]
fn a_million_operations_are_those_of_a_simple_list() {
    let shapes = [Shape::new(1, 0), Shape::new(3, 20), Shape::new(8, 7), Shape::new(33, 64)];
    let all = shapes.map(|shape| [1, 4].map(|senders| shape.senders(senders))).concat();
    let all: Vec<_> = all.into_iter().flat_map(|shape| [shape, shape.replacing()]).collect();
    for seed in drawn::drawn("mailbox", 1) {
        println!("RTNET_SEED={seed} cargo test -p package-router --lib a_million_operations");
        all.iter().zip(seed..).for_each(|(&shape, seed)| course(shape, 70_000, seed));
    }
}
