//! What a frame is and where in its cycle, as an observer's comments tell it, but exactly: by the clock of who gives the
//! time.

use rtnet::clock::True;

use crate::judge::analysis::Analysis;
use crate::observe::decode::{What, decode};
use crate::observe::watch::{Sight, When};

/// A frame on the medium that the analysis is given next.
pub fn sight(analysis: &Analysis, at: True, bytes: &[u8]) -> Sight {
    let decoded = decode(bytes, bytes.len());
    let of = match decoded.what {
        What::Data(tag) => analysis.author_of(&tag),
        _ => None,
    };
    if let Some(author) = of
        && let Some(error) = analysis.slot_error(at, author)
    {
        let (cycle, slot) = (Some(author.cycle), author.slot);
        return Sight { decoded, cycle, slot, when: When::SlotError(error) };
    }
    let (cycle, when) = match (decoded.what.scheduled(), analysis.place(at)) {
        (Some((cycle, due)), _) => (Some(cycle), When::SlotError(analysis.error(at, due))),
        (None, Some((cycle, place))) => (Some(cycle), When::Place(place)),
        (None, None) => (None, When::Unknown),
    };
    Sight { decoded, cycle, slot: None, when }
}
