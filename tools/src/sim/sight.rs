//! What a frame is and where in its cycle, as an observer's comments tell it, but exactly: by the clock of who gives the
//! time.

use rtnet::clock::True;
use rtnet::wire::ethernet::EtherType;

use crate::judge::analysis::Analysis;
use crate::judge::findings::Author;
use crate::observe::decode::{Decoded, What, decode};
use crate::observe::watch::{Sight, When};

/// What a frame is, and whose, if it is test traffic; what only looks like it is foreign.
pub fn decoded(analysis: &Analysis, bytes: &[u8]) -> (Decoded, Option<Author>) {
    let (mut decoded, author) =
        (decode(bytes, bytes.len()), analysis.author_of(bytes).map(|(_, author)| author));
    if let (What::Data(_), None) = (decoded.what, author) {
        decoded.what = What::Other(EtherType::EXPERIMENTAL, bytes.len());
    }
    (decoded, author)
}

/// A frame on the medium that the analysis is given next.
pub fn sight(analysis: &Analysis, at: True, bytes: &[u8]) -> Sight {
    let (decoded, author) = decoded(analysis, bytes);
    if let Some(author) = author
        && let Some(error) = analysis.slot_error(at, author)
    {
        let (cycle, slot) = (Some(author.cycle), author.slot);
        return Sight {
            decoded,
            cycle,
            slot,
            when: When::SlotError(error),
            offset: None,
            follows: None,
            count: None,
        };
    }
    let (cycle, when) = match (decoded.what.scheduled(), analysis.place(at)) {
        (Some((cycle, due)), _) => (Some(cycle), When::SlotError(analysis.error(at, due))),
        (None, Some((cycle, place))) => (Some(cycle), When::Place(place)),
        (None, None) => (None, When::Unknown),
    };
    Sight { decoded, cycle, slot: None, when, offset: None, follows: None, count: None }
}
