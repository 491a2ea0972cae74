//! Enumerations that can be gone through, for tables in which nothing is to be forgotten.

/// `ALL` has every variant, without a list beside that somebody would have to keep.
macro_rules! every {
    ($(#[$of:meta])* enum $name:ident { $($(#[$each:meta])* $variant:ident,)+ }) => {
        $(#[$of])*
        #[derive(Clone, Copy, Debug, PartialEq)]
        enum $name {
            $($(#[$each])* $variant,)+
        }

        impl $name {
            const ALL: &'static [Self] = &[$(Self::$variant),+];
        }
    };
}
pub(in crate::tdma) use every;
