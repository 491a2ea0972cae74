//! What wires do to frames: each entry of a file says something of some of them. Of what two say, the later one counts; what
//! is not said stays as it is.

use std::collections::BTreeMap;

use rtnet::sim::{Latency, Link};
use rtnet::time::Span;

use super::Conditions;

/// How late a frame is that others overtake, unless it is said.
const REORDER_BY: Span = Span::from_micros(100);

/// What is said of the wires of some stations.
#[derive(Clone, Debug, PartialEq)]
pub struct Wire {
    /// Whose.
    pub stations: Vec<usize>,
    /// In which direction.
    pub direction: Direction,
    /// Of each frame.
    pub effects: Effects,
}

/// A direction of a station's wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Direction {
    /// What it hears.
    In,
    /// What it sends.
    Out,
    /// Either.
    #[default]
    Both,
}

/// What becomes of frames, as a [`Link`] has it; what is not said stays.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Effects {
    /// RTmac frames in a million that are lost.
    pub lose_control_ppm: Option<u32>,
    /// The same for all other frames.
    pub lose_data_ppm: Option<u32>,
    /// Frames in a million that come twice.
    pub duplicate_ppm: Option<u32>,
    /// Of which a bit is changed.
    pub corrupt_ppm: Option<u32>,
    /// That others overtake.
    pub reorder_ppm: Option<u32>,
    /// By how much those come later.
    pub reorder_by: Option<Span>,
    /// How much later every frame comes.
    pub delay: Option<Latency>,
}

impl Effects {
    /// How much later a frame may come for it.
    pub fn longest(&self) -> Span {
        let delay = self.delay.as_ref().map_or(Span::ZERO, Latency::longest);
        delay + self.reorder_by.unwrap_or(REORDER_BY)
    }

    /// Whether they take a queue that knows time, as only a simulation has.
    pub fn hold_back(&self) -> bool {
        self.reorder_ppm.is_some_and(|ppm| ppm > 0)
            || self.delay.as_ref().is_some_and(|delay| *delay != Latency::NONE)
    }

    fn on(&self, link: Link) -> Link {
        Link {
            lose_control_ppm: self.lose_control_ppm.unwrap_or(link.lose_control_ppm),
            lose_data_ppm: self.lose_data_ppm.unwrap_or(link.lose_data_ppm),
            duplicate_ppm: self.duplicate_ppm.unwrap_or(link.duplicate_ppm),
            corrupt_ppm: self.corrupt_ppm.unwrap_or(link.corrupt_ppm),
            reorder_ppm: self.reorder_ppm.unwrap_or(link.reorder_ppm),
            reorder_by: self.reorder_by.unwrap_or(link.reorder_by),
            delay: self.delay.clone().unwrap_or(link.delay),
            down: link.down,
        }
    }
}

impl Conditions {
    /// What the wires of these stations do to what each sends, and to what it hears: throughout, or while an event says more of
    /// them.
    pub fn links(&self, stations: &[usize], event: Option<&Wire>) -> BTreeMap<usize, [Link; 2]> {
        let nothing = Link { reorder_by: REORDER_BY, ..Link::default() };
        let mut all: BTreeMap<_, _> =
            stations.iter().map(|&station| (station, [nothing.clone(), nothing.clone()])).collect();
        for Wire { stations, direction, effects } in self.wires.iter().chain(event) {
            for station in stations {
                let Some([sends_by, hears_by]) = all.get_mut(station) else { continue };
                if *direction != Direction::In {
                    *sends_by = effects.on(std::mem::take(sends_by));
                }
                if *direction != Direction::Out {
                    *hears_by = effects.on(std::mem::take(hears_by));
                }
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_later_wire_or_an_event_does_not_say_stays_as_it_was() {
        let wire =
            |stations: &[usize], direction, effects| Wire { stations: stations.to_vec(), direction, effects };
        let late = Latency::Constant(Span::from_micros(7));
        let (lossy, slow) = (
            Effects { lose_control_ppm: Some(1), lose_data_ppm: Some(2), ..Effects::default() },
            Effects { delay: Some(late.clone()), ..Effects::default() },
        );
        let spared = Effects { lose_data_ppm: Some(0), ..Effects::default() };
        let wires = vec![
            wire(&[0, 1, 2], Direction::Both, lossy),
            wire(&[2], Direction::In, slow),
            wire(&[1], Direction::Both, spared),
        ];
        let conditions = Conditions { wires, ..Conditions::default() };
        let figures = |links: &[Link; 2]| {
            links
                .each_ref()
                .map(|of| (of.lose_control_ppm, of.lose_data_ppm, of.corrupt_ppm, of.delay == late))
        };
        let links = conditions.links(&[1, 2], None);
        assert_eq!(links.keys().collect::<Vec<_>>(), [&1, &2]);
        assert_eq!(figures(&links[&1]), [(1, 0, 0, false); 2], "of one kind it is said otherwise");
        assert_eq!(figures(&links[&2]), [(1, 2, 0, false), (1, 2, 0, true)]);
        assert_eq!(links[&2][0].reorder_by, REORDER_BY);
        let event = wire(&[2], Direction::Out, Effects { corrupt_ppm: Some(5), ..Effects::default() });
        let links = conditions.links(&[2], Some(&event));
        assert_eq!(figures(&links[&2]), [(1, 2, 5, false), (1, 2, 0, true)]);
    }
}
