//! Which stations are drawn one by one, and how: no two alike, also without colours.

/// Colours that are told apart by who sees few of them, too; with each dash they are used once more.
const COLOURS: usize = 6;
const DASHES: usize = 4;
/// So many stations can be told apart.
pub const SERIES_MAX: usize = COLOURS * DASHES;

/// The stations of a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Those that are drawn one by one.
    pub stations: Vec<usize>,
    /// Those that are drawn together.
    pub others: Vec<usize>,
}

impl Series {
    /// All if there are few enough; else those whose figure is the largest, in the order of stations.
    pub fn of(figures: &[i64]) -> Self {
        let mut ranked: Vec<usize> = (0..figures.len()).collect();
        if figures.len() <= SERIES_MAX {
            return Self { stations: ranked, others: Vec::new() };
        }
        ranked.sort_by_key(|&station| (std::cmp::Reverse(figures[station]), station));
        let mut others = ranked.split_off(SERIES_MAX - 1);
        ranked.sort_unstable();
        others.sort_unstable();
        Self { stations: ranked, others }
    }

    /// How they are drawn: the classes of a line, by place.
    pub fn class(place: usize) -> String {
        format!("s{} d{}", place % COLOURS, place / COLOURS % DASHES)
    }

    /// How all the others are.
    pub const OTHERS: &str = "so d0";
}

/// A piece of such a line, for legends.
pub fn swatch(class: &str) -> String {
    format!(
        "<svg class=\"swatch {class}\" width=\"28\" height=\"8\" aria-hidden=\"true\"><line x1=\"0\" x2=\"28\" y1=\"4\" y2=\"4\"/></svg>"
    )
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn no_two_stations_are_drawn_alike() {
        let classes: BTreeSet<_> = (0..SERIES_MAX).map(Series::class).collect();
        assert_eq!(classes.len(), SERIES_MAX);
    }

    #[test]
    fn of_many_stations_the_worst_are_drawn_one_by_one() {
        assert_eq!(Series::of(&[3, 1, 2]), Series { stations: vec![0, 1, 2], others: vec![] });
        let mut figures = vec![1; 100];
        (figures[70], figures[5]) = (9, 8);
        let series = Series::of(&figures);
        assert!(series.stations.contains(&70) && series.stations.contains(&5));
        assert!(series.stations.is_sorted() && series.others.is_sorted());
        assert_eq!((series.stations.len(), series.others.len()), (SERIES_MAX - 1, 100 - SERIES_MAX + 1));
    }
}
