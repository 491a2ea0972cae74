//! Frames on their way to stations: each is kept once, however many are to hear it.

use super::seat::RECEIVE_POOL;
use crate::buf::{Buf, Pool, ROOM};

/// A frame that is kept, for one of those that are to hear it. It is given back by who has it.
#[derive(Debug, PartialEq, Eq)]
pub struct Kept(usize);

/// All that are on their way: on slow wires, or in receive pools, which hold no more than so many each.
pub struct Frames {
    places: Vec<Place>,
    /// Places without a frame, the one that was left last at the end.
    free: Vec<usize>,
    /// Stations look at one frame at a time, and hand over what they want to keep.
    shown: Pool,
}

struct Place {
    bytes: Box<[u8; ROOM]>,
    len: usize,
    /// So many are still to hear it.
    wanted_by: usize,
}

impl Frames {
    pub fn new() -> Self {
        Self { places: Vec::new(), free: Vec::new(), shown: Pool::new(RECEIVE_POOL) }
    }

    /// Keeps a frame, for one.
    pub fn keep(&mut self, frame: &[u8]) -> Kept {
        let free = self.free.pop().unwrap_or_else(|| {
            self.places.push(Place { bytes: Box::new([0; ROOM]), len: 0, wanted_by: 0 });
            // There is room for all of them to be free.
            self.free.reserve(self.places.len());
            self.places.len() - 1
        });
        let place = &mut self.places[free];
        place.bytes[..frame.len()].copy_from_slice(frame);
        (place.len, place.wanted_by) = (frame.len(), 1);
        Kept(free)
    }

    /// Keeps the same frame for one more.
    pub fn share(&mut self, frame: &Kept) -> Kept {
        self.places[frame.0].wanted_by += 1;
        Kept(frame.0)
    }

    /// Keeps one more, for one, that may be changed.
    pub fn copy(&mut self, frame: &Kept) -> Kept {
        let Place { bytes, len, .. } = &self.places[frame.0];
        let (bytes, len) = (**bytes, *len);
        self.keep(&bytes[..len])
    }

    pub fn bytes(&self, frame: &Kept) -> &[u8] {
        let Place { bytes, len, .. } = &self.places[frame.0];
        &bytes[..*len]
    }

    /// To be changed for all that are to hear it.
    pub fn bytes_mut(&mut self, frame: &Kept) -> &mut [u8] {
        let Place { bytes, len, .. } = &mut self.places[frame.0];
        &mut bytes[..*len]
    }

    /// One hears it: a copy to look at, unless those that looked before have kept theirs.
    pub fn hear(&mut self, frame: Kept) -> Option<Buf> {
        let shown = self.shown.take().map(|mut shown| {
            shown.fill(self.bytes(&frame));
            shown
        });
        self.leave(frame);
        shown
    }

    /// One will not hear it.
    pub fn leave(&mut self, frame: Kept) {
        let place = &mut self.places[frame.0];
        place.wanted_by -= 1;
        if place.wanted_by == 0 {
            self.free.push(frame.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_that_many_hear_is_kept_once_and_until_the_last() {
        let mut frames = Frames::new();
        let first = frames.keep(b"to all");
        let second = frames.share(&first);
        assert_eq!(frames.places.len(), 1);
        assert_eq!(frames.hear(first).as_deref(), Some(&b"to all"[..]));
        let other = frames.keep(b"to one");
        assert_eq!(frames.hear(second).as_deref(), Some(&b"to all"[..]), "the other has another place");
        frames.leave(other);
        assert_eq!((frames.places.len(), frames.free.len()), (2, 2));
        frames.keep(b"again");
        assert_eq!((frames.places.len(), frames.free.len()), (2, 1), "in a place that was left");
    }

    #[test]
    fn what_is_changed_for_one_is_as_it_was_for_the_others() {
        let mut frames = Frames::new();
        let genuine = frames.keep(b"genuine");
        let changed = frames.copy(&genuine);
        frames.bytes_mut(&changed)[0] = b'G';
        assert_eq!(frames.hear(changed).as_deref(), Some(&b"Genuine"[..]));
        assert_eq!(frames.hear(genuine).as_deref(), Some(&b"genuine"[..]));
    }

    #[test]
    fn who_keeps_what_is_shown_loses_the_next() {
        let mut frames = Frames::new();
        let mut hear = || {
            let frame = frames.keep(b"frame");
            frames.hear(frame)
        };
        let held: Vec<_> = (0..RECEIVE_POOL).map_while(|_| hear()).collect();
        assert_eq!((held.len(), hear().is_none()), (RECEIVE_POOL, true));
        drop(held);
        assert!(hear().is_some());
    }
}
