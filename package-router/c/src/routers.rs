//! A component's connection to a TCP router.

use core::ffi::c_char;

use package_router::tcp::client::TcpStatus;

use crate::components::RtnetComponent;
use crate::failure::Failure;
use crate::guard::guard;
use crate::pointers::{shared, write};

/// Bytes of an error's text, the zero at its end included.
const TEXT: usize = 160;

/// `struct rtnet_router_status`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct RtnetRouterStatus {
    connections: u64,
    sent: u64,
    received: u64,
    not_connected: u64,
    not_written: u64,
    unconfirmed: u64,
    lost_at_router: u64,
    names_refused: u64,
    queue_full: u64,
    nobody_there: u64,
    receiver_full: u64,
    too_large: u64,
    foreign_senders: u64,
    answers_lost: u64,
    is_connected: u32,
    mailboxes: u32,
    mailboxes_waiting: u32,
    reserved: u32,
    last_error: [c_char; TEXT],
}

// As the header says.
const _: () = assert!(size_of::<RtnetRouterStatus>() == 288);

impl From<&TcpStatus> for RtnetRouterStatus {
    fn from(status: &TcpStatus) -> Self {
        Self {
            connections: status.connections,
            sent: status.session.sent,
            received: status.session.received,
            not_connected: status.local.not_connected,
            not_written: status.session.lost,
            unconfirmed: status.session.unconfirmed,
            lost_at_router: status.session.lost_at_router.sum(),
            names_refused: status.session.names_refused,
            queue_full: status.local.queue_full,
            nobody_there: status.local.no_mailbox,
            receiver_full: status.local.full,
            too_large: status.local.too_large,
            foreign_senders: status.local.forged,
            answers_lost: status.session.answers_lost,
            is_connected: status.is_connected.into(),
            mailboxes: count(status.names),
            mailboxes_waiting: count(status.names_waiting),
            reserved: 0,
            last_error: text(
                status.last_error.as_deref().filter(|_| !status.is_connected).unwrap_or_default(),
            ),
        }
    }
}

fn count(of: usize) -> u32 {
    u32::try_from(of).unwrap_or(u32::MAX)
}

/// As much of it as fits, with a zero behind it; no character is cut.
fn text(of: &str) -> [c_char; TEXT] {
    let end = of.floor_char_boundary(TEXT - 1);
    let mut room = [0; TEXT];
    room.iter_mut().zip(of[..end].bytes()).for_each(|(to, byte)| *to = byte as c_char);
    room
}

/// The connection of a component to its router.
///
/// # SAFETY
/// `component` is NULL or a handle, `status` NULL or the place of a status.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_component_router_status(
    component: *const RtnetComponent,
    status: *mut RtnetRouterStatus,
) -> i32 {
    guard("rtnet_component_router_status", || {
        // SAFETY: as the caller promises.
        let watch = unsafe { shared("component", component) }?.0.tcp().ok_or(Failure::OfStation)?;
        // SAFETY: as the caller promises.
        unsafe { write("status", status, RtnetRouterStatus::from(&watch.status())) }?;
        Ok(0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_error_is_cut_between_characters() {
        let long = format!("x{}", "ü".repeat(TEXT));
        let kept: Vec<u8> =
            text(&long).iter().map(|&byte| byte as u8).take_while(|&byte| byte != 0).collect();
        assert_eq!(String::from_utf8(kept).unwrap(), format!("x{}", "ü".repeat((TEXT - 2) / 2)));
        assert!(text("").iter().all(|&byte| byte == 0));
    }
}
