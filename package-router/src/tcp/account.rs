//! The account of a connection: its packages that its router has read and not passed on, by reason, and those that still wait there.

use super::numbers::numbers;

numbers! {
    /// Packages by the reason for which the router did not pass them on. Commands among them were answered NOT_AVAILABLE.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub struct Lost {
        /// To names that nobody had.
        nobody_there,
        /// In the name of another connection.
        foreign_senders,
        /// Not allowed by a rule.
        forbidden,
        /// They found their receiver's queue full.
        receiver_full,
        /// They made room for more urgent ones in their receiver's queue.
        overtaken,
        /// They waited for their receiver when its connection ended, or its kernel had not confirmed them.
        receiver_gone,
    }
}

impl Lost {
    /// All together.
    pub fn sum(&self) -> u64 {
        self.numbers().into_iter().fold(0, u64::saturating_add)
    }

    /// Adds another's. A sum ends at the largest number: a router may send anything.
    pub fn plus(&self, other: &Self) -> Self {
        self.with(other, u64::saturating_add)
    }

    /// The larger of each number.
    pub fn max(&self, other: &Self) -> Self {
        self.with(other, u64::max)
    }
}

/// The account of a connection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Packages that were not passed on.
    pub lost: Lost,
    /// Packages that wait at the router, and those that the kernels of their receivers have not confirmed.
    pub waiting: u64,
}

impl Account {
    /// Bytes of the answer's body: a number of 8 bytes of those that wait, and one for each reason.
    pub const LEN: usize = (Lost::COUNT + 1) * size_of::<u64>();

    /// The body of an answer, little-endian.
    pub fn to_bytes(&self) -> [u8; Self::LEN] {
        let mut bytes = [0; Self::LEN];
        let numbers = [self.waiting].into_iter().chain(self.lost.numbers());
        for (at, number) in bytes.chunks_exact_mut(size_of::<u64>()).zip(numbers) {
            at.copy_from_slice(&number.to_le_bytes());
        }
        bytes
    }

    /// Reads such a body; `None`: it is none. A router of another version may know more reasons, or fewer.
    pub fn parse(body: &[u8]) -> Option<Self> {
        let (numbers, rest) = body.as_chunks();
        let at = |place: usize| numbers.get(place).map_or(0, |number| u64::from_le_bytes(*number));
        let is_one = rest.is_empty() && !numbers.is_empty();
        is_one.then(|| Self { waiting: at(0), lost: Lost::of(core::array::from_fn(|reason| at(reason + 1))) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn its_bytes_are_numbers_in_order() {
        let large = 0x0102_0304_0506_0708;
        let account = Account { lost: Lost::of([1, 2, 3, 4, 5, large]), waiting: 7 };
        let bytes = account.to_bytes();
        let numbers = [7, 1u64, 2, 3, 4, 5, large].map(u64::to_le_bytes).concat();
        assert_eq!((&bytes[..], Account::parse(&bytes)), (&numbers[..], Some(account)));
        let more = [&bytes[..], &[9; 16]].concat();
        assert_eq!(Account::parse(&more), Some(account), "reasons that are not known here");
        let fewer = Account { lost: Lost::of([1, 2, 0, 0, 0, 0]), waiting: 7 };
        assert_eq!(Account::parse(&bytes[..24]), Some(fewer));
        for wrong in [0, 7, 55, 57] {
            assert_eq!(Account::parse(&vec![0; wrong]), None);
        }
    }

    #[test]
    fn sums_end_at_the_largest_number() {
        let (some, most) = (Lost::of([1, 2, 3, 4, 5, 6]), Lost::of([u64::MAX; 6]));
        assert_eq!((some.sum(), most.sum()), (21, u64::MAX));
        assert_eq!((some.plus(&some), some.plus(&most)), (Lost::of([2, 4, 6, 8, 10, 12]), most));
        assert_eq!(some.max(&Lost::of([6, 5, 4, 3, 2, 1])), Lost::of([6, 5, 4, 4, 5, 6]));
    }
}
