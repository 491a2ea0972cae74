//! Packages' heads as C has them.

use package_router::wire::{Endian, Head};

use crate::failure::Failure;

/// `struct rtnet_head`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RtnetHead {
    to: u32,
    from: u32,
    len: u32,
    kind: i8,
    priority: u8,
    id: u8,
    big_endian: u8,
}

// As the header says.
const _: () = assert!(size_of::<RtnetHead>() == 16);

impl RtnetHead {
    /// Of a package that is to be sent: the rest is its sender's to say.
    pub(crate) fn to_send(self) -> Result<Head, Failure> {
        let RtnetHead { kind, priority, id, big_endian, .. } = self;
        let body_order = match big_endian {
            0 => Endian::Little,
            1 => Endian::Big,
            other => return Err(Failure::Number("head->big_endian", other.into())),
        };
        Ok(Head { kind, priority, id, body_order, ..Head::default() })
    }
}

impl From<&Head> for RtnetHead {
    fn from(head: &Head) -> Self {
        Self {
            to: head.to.0,
            from: head.from.0,
            len: head.body_len() as u32,
            kind: head.kind,
            priority: head.priority,
            id: head.id,
            big_endian: (head.body_order == Endian::Big).into(),
        }
    }
}
