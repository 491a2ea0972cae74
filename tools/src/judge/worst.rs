//! Where it was worst: a figure's extreme, and its cycle.

/// The largest of what was noted, and the cycle in which that was for the first time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Worst(Option<(i64, u32)>);

impl Worst {
    /// A value in a cycle.
    pub fn note(&mut self, value: i64, cycle: u32) {
        if self.0.is_none_or(|(worst, _)| value > worst) {
            self.0 = Some((value, cycle));
        }
    }

    /// The worse of two.
    pub fn or(self, other: Worst) -> Worst {
        if other.value() > self.value() { other } else { self }
    }

    /// In which cycle it was.
    pub fn cycle(self) -> Option<u32> {
        self.0.map(|(_, cycle)| cycle)
    }

    /// How much it was.
    pub fn value(self) -> Option<i64> {
        self.0.map(|(value, _)| value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_of_the_largest_is_kept_also_among_several() {
        let (mut one, mut other) = (Worst::default(), Worst::default());
        [(-3, 7), (5, 8), (5, 9), (1, 10)].iter().for_each(|&(value, cycle)| one.note(value, cycle));
        assert_eq!((one.value(), one.cycle()), (Some(5), Some(8)));
        assert_eq!((one.or(other), other.or(one)), (one, one));
        other.note(6, 20);
        assert_eq!((one.or(other), other.or(one)), (other, other));
    }
}
