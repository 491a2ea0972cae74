//! Labels below a row of slots: each is there, and meets no other.

use std::fmt::Write;

use super::escaped;
use crate::report::text::cut;

/// Of a letter of 10 px, at the most on average: few names have more than one M or W.
const LETTER: f64 = 6.0;
/// Between two labels side by side.
const SPACE: f64 = 6.0;
/// A slanting label goes down to the left by so many degrees, and is so far from the next: more than its letters are high.
const SLANT: f64 = 55.0;
const APART: f64 = 14.0;
/// From a slot to its slanting label.
const LEAD: f64 = 12.0;
/// A longer name of a station is cut. Pointing at the slot shows all of it.
const LETTERS_AT_MOST: usize = 18;

/// What stands below a slot that begins at `at`.
pub(super) struct Label {
    pub at: f64,
    pub text: String,
}

impl Label {
    /// The label of a slot. Only the station's name is cut: slots of one station differ by the rest.
    pub fn of(at: f64, station: &str, slot: &str) -> Self {
        Self { at, text: format!("{} {slot}", cut(station, LETTERS_AT_MOST)) }
    }
}

/// The labels of a row.
pub(super) struct Labels {
    /// In order, and where each begins.
    placed: Vec<(Label, f64)>,
    is_slanting: bool,
}

/// How wide a text of 10 px is, at the most.
pub(super) fn width(text: &str) -> f64 {
    LETTER * text.chars().count() as f64
}

impl Labels {
    /// Side by side, if they have room between `left` and `right`, else slanting.
    pub fn place(mut labels: Vec<Label>, left: f64, right: f64) -> Self {
        labels.sort_by(|a, b| a.at.total_cmp(&b.at));
        let ends = labels.iter().skip(1).map(|next| next.at - SPACE).chain([right + SPACE]);
        let is_slanting = labels.iter().zip(ends).any(|(label, end)| label.at + width(&label.text) > end);
        let mut places: Vec<f64> = labels.iter().map(|label| label.at).collect();
        if is_slanting {
            spread(&mut places, left, right);
        }
        Self { placed: labels.into_iter().zip(places).collect(), is_slanting }
    }

    /// The width that so many need.
    pub fn room_for(labels: usize) -> f64 {
        APART * labels as f64
    }

    pub fn height(&self) -> f64 {
        if !self.is_slanting {
            return 14.0;
        }
        let longest = self.placed.iter().map(|(label, _)| width(&label.text)).fold(0.0, f64::max);
        LEAD + 8.0 + longest * SLANT.to_radians().sin()
    }

    /// Below a row that ends at `y`.
    pub fn draw(&self, svg: &mut String, y: f64) {
        for (label, x) in &self.placed {
            let text = escaped(&label.text);
            if !self.is_slanting {
                let _ =
                    writeln!(svg, "<text x=\"{x:.2}\" y=\"{:.1}\" class=\"small\">{text}</text>", y + 11.0);
                continue;
            }
            let (at, below) = (label.at, y + LEAD);
            let _ = writeln!(
                svg,
                "<line class=\"lead\" x1=\"{at:.2}\" y1=\"{y:.1}\" x2=\"{x:.2}\" y2=\"{below:.1}\"/>\n<text text-anchor=\"end\" \
                 transform=\"translate({:.2} {:.1}) rotate(-{SLANT})\" class=\"small\">{text}</text>",
                x + 3.0,
                below + 5.0
            );
        }
    }
}

/// Moves places that are in order so far apart that labels have room, as little as may be to the right, and none beyond the
/// ends as long as all have room between them.
fn spread(places: &mut [f64], left: f64, right: f64) {
    let mut least = left;
    for place in &mut *places {
        *place = place.max(least);
        least = *place + APART;
    }
    let mut most = right;
    for place in places.iter_mut().rev() {
        *place = place.min(most);
        most = *place - APART;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn placed(slots: &[f64], text: &str) -> (Vec<f64>, bool) {
        let label = |&at: &f64| Label { at, text: text.into() };
        let labels = Labels::place(slots.iter().map(label).collect(), 100.0, 300.0);
        (labels.placed.iter().map(|&(_, x)| x).collect(), labels.is_slanting)
    }

    #[test]
    fn labels_stand_below_their_slots_while_there_is_room() {
        assert_eq!(placed(&[120.0, 160.0, 240.0], "arm 0"), (vec![120.0, 160.0, 240.0], false));
        assert!(placed(&[120.0, 155.0], "arm 0").1, "30 px and 6 between");
        assert!(placed(&[280.0], "arm 0").1, "beyond the end");
    }

    #[test]
    fn slanting_labels_keep_their_order_and_distance() {
        assert_eq!(placed(&[120.0, 122.0, 200.0], "arm 0"), (vec![120.0, 134.0, 200.0], true));
        assert_eq!(placed(&[296.0, 298.0, 299.0], "arm 0"), (vec![272.0, 286.0, 300.0], true));
        let full: Vec<f64> = (0..14).map(|_| 200.0).collect();
        let (places, _) = placed(&full, "arm 0");
        assert!(places.windows(2).all(|pair| pair[1] - pair[0] >= APART), "{places:?}");
        assert!(places[0] >= 100.0 && places[13] <= 300.0, "{places:?}");
    }
}
