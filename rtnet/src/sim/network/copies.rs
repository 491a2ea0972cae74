//! What becomes of one frame for one station, of which several copies may be on their way: it is lost only if none of
//! them comes as it was sent.

use super::carriage::Loss;

/// The copies of one frame for one station.
#[derive(Default)]
pub struct Copies {
    /// Whether one has come.
    came: bool,
    /// Why it is lost if none does.
    lost: Option<Loss>,
    /// Where those are counted that are still on their way.
    later: Option<usize>,
}

impl Copies {
    /// One was handed to the station, or was not.
    pub fn note(&mut self, reached: Result<(), Loss>) {
        match reached {
            Ok(()) => self.came = true,
            // What somebody wanted to be lost alone would not have lost it.
            Err(why) if self.lost.is_none_or(Loss::is_on_purpose) => self.lost = Some(why),
            Err(_) => {}
        }
    }

    /// One is on its way: under this number, by which it is to be told of later.
    pub fn note_later(&mut self, later: &mut Later) -> usize {
        let place = *self.later.get_or_insert_with(|| later.begin());
        later.places[place].copies += 1;
        place
    }

    /// All have left: why the frame is lost, if that is certain already.
    pub fn conclude(self, later: &mut Later) -> Option<Loss> {
        match self.later {
            Some(place) => later.places[place].came = self.came,
            None if !self.came => return self.lost,
            None => {}
        }
        None
    }
}

/// Frames of which copies are still on their way, each for one station.
#[derive(Default)]
pub struct Later {
    places: Vec<Place>,
    free: Vec<usize>,
}

#[derive(Default)]
struct Place {
    copies: usize,
    came: bool,
}

impl Later {
    fn begin(&mut self) -> usize {
        let place = self.free.pop().unwrap_or_else(|| {
            self.places.push(Place::default());
            // There is room for all of them to be free.
            self.free.reserve(self.places.len());
            self.places.len() - 1
        });
        self.places[place] = Place::default();
        place
    }

    /// One of the copies under this number has come, or not: whether that was the last, and the frame is lost.
    pub fn end_of_one(&mut self, number: usize, came: bool) -> bool {
        let place = &mut self.places[number];
        place.copies -= 1;
        place.came |= came;
        let (is_last, is_lost) = (place.copies == 0, !place.came);
        if is_last {
            self.free.push(number);
        }
        is_last && is_lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_lost_only_if_no_copy_comes_and_then_once() {
        let mut later = Later::default();
        let mut ends = |at_once: &[Result<(), Loss>], came: &[bool]| {
            let mut copies = Copies::default();
            at_once.iter().for_each(|&reached| copies.note(reached));
            let numbers: Vec<_> = came.iter().map(|_| copies.note_later(&mut later)).collect();
            let at_once = copies.conclude(&mut later).is_some();
            let ends = numbers.iter().zip(came).map(|(&number, &came)| later.end_of_one(number, came));
            (at_once, ends.collect::<Vec<_>>())
        };
        assert_eq!(ends(&[Ok(())], &[]), (false, vec![]));
        assert_eq!(ends(&[Err(Loss::Wire)], &[]), (true, vec![]));
        assert_eq!(ends(&[Err(Loss::Wire), Ok(())], &[]), (false, vec![]));
        assert_eq!(ends(&[Ok(())], &[false]), (false, vec![false]), "the first came");
        assert_eq!(ends(&[], &[false, true]), (false, vec![false, false]), "the second came");
        assert_eq!(ends(&[], &[true, false]), (false, vec![false, false]));
        assert_eq!(ends(&[Err(Loss::Wire)], &[false, false]), (false, vec![false, true]));
        assert_eq!((later.places.len(), later.free.len()), (1, 1));
    }

    #[test]
    fn a_frame_is_lost_on_purpose_only_if_all_copies_are() {
        let why = |lost: [Loss; 2]| {
            let mut copies = Copies::default();
            lost.into_iter().for_each(|why| copies.note(Err(why)));
            copies.conclude(&mut Later::default())
        };
        assert_eq!(why([Loss::Wire, Loss::Cut]), Some(Loss::Cut));
        assert_eq!(why([Loss::Wire, Loss::NoBuffer]), Some(Loss::NoBuffer));
        assert_eq!(why([Loss::QueueFull, Loss::Wire]), Some(Loss::QueueFull));
    }
}
