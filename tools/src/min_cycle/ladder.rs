//! The cycles that are tried: the E24 series, of which each is about a tenth longer than the one before. A finer one would
//! tell apart what two runs on one host do not agree on.

use rtnet::time::Span;

/// A decade of them.
const E24: [i64; 24] =
    [10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91];

/// The shortest: a tenth of what any host here has held.
pub const SHORTEST: Span = Span::from_micros(51);

/// All cycles from [`SHORTEST`] to `longest`, the shortest first.
pub fn up_to(longest: Span) -> Vec<Span> {
    let decades = (0..).map(|power| 10_i64.pow(power) * 1_000);
    let all = decades.flat_map(|unit| E24.map(|of| Span::from_nanos(of * unit)));
    all.take_while(|&cycle| cycle <= longest).filter(|&cycle| cycle >= SHORTEST).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_is_about_a_tenth_longer_and_two_are_less_than_a_quarter() {
        let all = up_to(Span::from_millis(10));
        assert_eq!((all[0], all.last()), (Span::from_micros(51), Some(&Span::from_millis(10))));
        let ratio = |of: &[Span]| of[of.len() - 1].nanos() as f64 / of[0].nanos() as f64;
        assert!(all.windows(2).all(|of| (1.06..1.16).contains(&ratio(of))));
        assert!(all.windows(3).all(|of| ratio(of) <= 1.25));
        assert_eq!(up_to(Span::from_micros(50)), []);
    }
}
