//! The account of a connection: the packages of it that its router has read and not passed on, by reason.

macro_rules! reasons {
    ($($(#[$doc:meta])* $name:ident),+ $(,)?) => {
        /// Packages by the reason for which the router did not pass them on. Commands among them were answered NOT_AVAILABLE.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct Account {
            $($(#[$doc])* pub $name: u64,)+
        }

        impl Account {
            /// Bytes of the answer's body: a number of 8 bytes for each reason.
            pub const LEN: usize = [$(stringify!($name)),+].len() * size_of::<u64>();

            /// Each with its name.
            pub fn each(&self) -> impl Iterator<Item = (&'static str, u64)> {
                [$((stringify!($name), self.$name)),+].into_iter()
            }

            /// The body of an answer, little-endian.
            pub fn to_bytes(&self) -> [u8; Self::LEN] {
                let mut bytes = [0; Self::LEN];
                for (at, number) in bytes.chunks_exact_mut(size_of::<u64>()).zip([$(self.$name),+]) {
                    at.copy_from_slice(&number.to_le_bytes());
                }
                bytes
            }

            /// Reads such a body; `None`: it has another length.
            pub fn parse(body: &[u8]) -> Option<Self> {
                let body: &[u8; Self::LEN] = body.try_into().ok()?;
                let mut numbers = body.chunks_exact(size_of::<u64>());
                let mut next = || Some(u64::from_le_bytes(numbers.next()?.try_into().ok()?));
                Some(Self { $($name: next()?),+ })
            }

            /// Adds another's. Sums end at the largest number: a router may say anything.
            pub fn plus(&self, other: &Self) -> Self {
                Self { $($name: self.$name.saturating_add(other.$name)),+ }
            }

            /// All together.
            pub fn sum(&self) -> u64 {
                self.each().fold(0, |sum, (_, number)| sum.saturating_add(number))
            }
        }
    };
}

reasons! {
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
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn its_bytes_are_numbers_in_order() {
        let account = Account {
            nobody_there: 1,
            foreign_senders: 2,
            forbidden: 3,
            receiver_full: 4,
            overtaken: 0x0102_0304_0506_0708,
        };
        let bytes = account.to_bytes();
        let numbers = [1u64, 2, 3, 4, 0x0102_0304_0506_0708].map(u64::to_le_bytes).concat();
        assert_eq!((&bytes[..], Account::parse(&bytes)), (&numbers[..], Some(account)));
        for wrong in [0, 39, 41, 48] {
            assert_eq!(Account::parse(&vec![0; wrong]), None);
        }
        assert_eq!((account.sum(), account.plus(&account).forbidden), (10 + 0x0102_0304_0506_0708, 6));
    }
}
