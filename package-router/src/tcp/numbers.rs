//! Structs of numbers that are known by their names.

/// A struct of `u64`, which can be taken apart and put together in the order of its fields.
macro_rules! numbers {
    ($(#[$meta:meta])* pub struct $Numbers:ident { $($(#[$doc:meta])* $name:ident),+ $(,)? }) => {
        $(#[$meta])*
        pub struct $Numbers {
            $($(#[$doc])* pub $name: u64,)+
        }

        impl $Numbers {
            const COUNT: usize = [$(stringify!($name)),+].len();

            /// Each with its name.
            pub fn each(&self) -> impl Iterator<Item = (&'static str, u64)> {
                [$((stringify!($name), self.$name)),+].into_iter()
            }

            fn numbers(&self) -> [u64; Self::COUNT] {
                [$(self.$name),+]
            }

            fn of(numbers: [u64; Self::COUNT]) -> Self {
                let [$($name),+] = numbers;
                Self { $($name),+ }
            }

            /// Both, number by number.
            fn with(&self, other: &Self, both: impl Fn(u64, u64) -> u64) -> Self {
                let (ours, theirs) = (self.numbers(), other.numbers());
                Self::of(core::array::from_fn(|at| both(ours[at], theirs[at])))
            }
        }
    };
}

pub(super) use numbers;
