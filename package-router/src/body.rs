//! Typed bodies: records, packed, in the byte order that the head says.
//!
//! A record is a plain struct of Rust that [`record!`](crate::record) also gives its layout on the wire, in both orders:
//!
//! ```
//! use package_router::body::{self, BodyError};
//! use package_router::record;
//! use package_router::wire::Endian;
//!
//! record! {
//!     /// Where a robot is by what its wheels say: 28 bytes.
//!     #[derive(Clone, Copy, Debug, PartialEq)]
//!     pub struct Odometry {
//!         /// Global time, ms.
//!         pub t: u32,
//!         /// Position, mm.
//!         pub x: i32,
//!         pub y: i32,
//!         pub z: i32,
//!         /// Orientation, rad.
//!         pub phi: f32,
//!         pub psi: f32,
//!         pub rho: f32,
//!     }
//! }
//!
//! let here = Odometry { t: 1_000, x: -250, y: 80, z: 0, phi: 0.0, psi: 0.0, rho: 1.5 };
//! let mut bytes = [0; 32];
//! let len = body::write(&here, Endian::Big, &mut bytes)?;
//! assert_eq!((len, body::len::<Odometry>()), (28, 28));
//! assert_eq!(bytes[..8], [0, 0, 0x03, 0xe8, 0xff, 0xff, 0xff, 0x06]);
//! assert_eq!(body::read(&bytes[..len], Endian::Big), Ok(here));
//!
//! // A body has exactly the record's bytes, unless an array follows.
//! let error = body::read::<Odometry>(&bytes, Endian::Big);
//! assert_eq!(error, Err(BodyError::WrongLen { expected: 28, got: 32 }));
//! let (first, rest) = body::read_prefix::<Odometry>(&bytes, Endian::Big)?;
//! assert_eq!((first, rest), (here, &[0; 4][..]));
//! # Ok::<(), BodyError>(())
//! ```

use zerocopy::byteorder::{BigEndian, F32, F64, I16, I32, I64, LittleEndian, U16, U32, U64};
use zerocopy::{ByteOrder, FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::name::MailboxName;
pub use crate::record;
use crate::wire::Endian;

/// What a body can hold: numbers, names, arrays of them, nothing at all, and what [`record!`](crate::record) defines.
///
/// Text is an array of bytes, padded with zeros. A boolean is a number: which one is false is the record's business.
pub trait Record: Sized {
    /// Its bytes, packed, with numbers of that order.
    type Wire<O: ByteOrder>: FromBytes + IntoBytes + KnownLayout + Immutable + Unaligned;

    /// Reads its fields.
    fn from_wire<O: ByteOrder>(wire: &Self::Wire<O>) -> Self;

    /// Writes its fields.
    fn to_wire<O: ByteOrder>(&self) -> Self::Wire<O>;
}

/// A body that does not hold the record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BodyError {
    /// It is of another length.
    #[error("a body of {got} bytes: this record has exactly {expected}")]
    WrongLen {
        /// Bytes of the record.
        expected: usize,
        /// Bytes there are.
        got: usize,
    },
    /// It ends within the record.
    #[error("a body of {got} bytes: this record takes {least} of it")]
    TooShort {
        /// Bytes of the record.
        least: usize,
        /// Bytes there are.
        got: usize,
    },
    /// There is no room to write it.
    #[error("room for {room} bytes: this record has {needed}")]
    NoRoom {
        /// Bytes of the record.
        needed: usize,
        /// Bytes there are.
        room: usize,
    },
}

/// Bytes of a record in a body, in either order.
pub const fn len<R: Record>() -> usize {
    size_of::<R::Wire<LittleEndian>>()
}

/// Reads a body that is one record and nothing else.
pub fn read<R: Record>(body: &[u8], order: Endian) -> Result<R, BodyError> {
    match read_prefix(body, order) {
        Ok((record, [])) => Ok(record),
        _ => Err(BodyError::WrongLen { expected: len::<R>(), got: body.len() }),
    }
}

/// Reads a record, and returns what follows it: an array of which the record tells how long it is.
pub fn read_prefix<R: Record>(body: &[u8], order: Endian) -> Result<(R, &[u8]), BodyError> {
    match order {
        Endian::Big => prefix::<R, BigEndian>(body),
        Endian::Little => prefix::<R, LittleEndian>(body),
    }
}

/// Writes a record to the begin of `into` and returns how many bytes it has.
pub fn write<R: Record>(record: &R, order: Endian, into: &mut [u8]) -> Result<usize, BodyError> {
    let room = into.len();
    let written = match order {
        Endian::Big => record.to_wire::<BigEndian>().write_to_prefix(into).is_ok(),
        Endian::Little => record.to_wire::<LittleEndian>().write_to_prefix(into).is_ok(),
    };
    let needed = len::<R>();
    if written { Ok(needed) } else { Err(BodyError::NoRoom { needed, room }) }
}

fn prefix<R: Record, O: ByteOrder>(body: &[u8]) -> Result<(R, &[u8]), BodyError> {
    let too_short = BodyError::TooShort { least: size_of::<R::Wire<O>>(), got: body.len() };
    let (wire, rest) = R::Wire::<O>::read_from_prefix(body).map_err(|_| too_short)?;
    Ok((R::from_wire(&wire), rest))
}

/// Defines a struct and its layout in a body: its fields, of types that are [`Record`](crate::body::Record)s, in their order and
/// packed. The crate that uses it depends on `zerocopy` with `derive`. See [`body`](crate::body) for an example.
#[macro_export]
macro_rules! record {
    ($(#[$meta:meta])* $vis:vis struct $name:ident {
        $($(#[$field_meta:meta])* $field_vis:vis $field:ident: $kind:ty),+ $(,)?
    }) => {
        $(#[$meta])*
        $vis struct $name { $($(#[$field_meta])* $field_vis $field: $kind),+ }

        const _: () = {
            #[derive(
                ::zerocopy::FromBytes, ::zerocopy::IntoBytes, ::zerocopy::KnownLayout, ::zerocopy::Immutable,
                ::zerocopy::Unaligned,
            )]
            #[repr(C)]
            $vis struct Wire<O: ::zerocopy::ByteOrder> {
                $($field: <$kind as $crate::body::Record>::Wire<O>),+
            }

            impl $crate::body::Record for $name {
                type Wire<O: ::zerocopy::ByteOrder> = Wire<O>;

                fn from_wire<O: ::zerocopy::ByteOrder>(wire: &Wire<O>) -> Self {
                    Self { $($field: <$kind as $crate::body::Record>::from_wire::<O>(&wire.$field)),+ }
                }
                fn to_wire<O: ::zerocopy::ByteOrder>(&self) -> Wire<O> {
                    Wire { $($field: <$kind as $crate::body::Record>::to_wire::<O>(&self.$field)),+ }
                }
            }
        };
    };
}

macro_rules! numbers {
    ($($number:ty => $wire:ident),+) => {
        $(impl Record for $number {
            type Wire<O: ByteOrder> = $wire<O>;

            fn from_wire<O: ByteOrder>(wire: &$wire<O>) -> Self {
                wire.get()
            }
            fn to_wire<O: ByteOrder>(&self) -> $wire<O> {
                $wire::new(*self)
            }
        })+
    };
}

numbers!(u16 => U16, i16 => I16, u32 => U32, i32 => I32, u64 => U64, i64 => I64, f32 => F32, f64 => F64);

/// What has the same bytes in either order.
macro_rules! as_they_are {
    ($($kind:ty),+) => {
        $(impl Record for $kind {
            type Wire<O: ByteOrder> = $kind;

            fn from_wire<O: ByteOrder>(wire: &$kind) -> Self {
                *wire
            }
            fn to_wire<O: ByteOrder>(&self) -> $kind {
                *self
            }
        })+
    };
}

as_they_are!(u8, i8, ());

impl Record for MailboxName {
    type Wire<O: ByteOrder> = U32<O>;

    fn from_wire<O: ByteOrder>(wire: &U32<O>) -> Self {
        Self(wire.get())
    }
    fn to_wire<O: ByteOrder>(&self) -> U32<O> {
        U32::new(self.0)
    }
}

impl<R: Record, const N: usize> Record for [R; N] {
    type Wire<O: ByteOrder> = [R::Wire<O>; N];

    fn from_wire<O: ByteOrder>(wire: &Self::Wire<O>) -> Self {
        core::array::from_fn(|at| R::from_wire(&wire[at]))
    }
    fn to_wire<O: ByteOrder>(&self) -> Self::Wire<O> {
        core::array::from_fn(|at| self[at].to_wire())
    }
}

#[cfg(test)]
mod tests;
