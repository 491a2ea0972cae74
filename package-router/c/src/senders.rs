//! Ways from a mailbox to another.

use core::ffi::c_void;

use package_router::component::Sender;
use package_router::name::MailboxName;

use crate::failure::Failure;
use crate::guard::guard;
use crate::heads::RtnetHead;
use crate::mailboxes::RtnetMailbox;
use crate::pointers::{bytes, exclusive, give, give_back, shared, write};

/// `rtnet_sender`.
pub struct RtnetSender(Sender);

/// A way from a mailbox to another.
///
/// # SAFETY
/// `from` is NULL or a handle that nobody else uses, `sender` NULL or the place of a pointer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_sender_bind(
    from: *mut RtnetMailbox,
    to: u32,
    sender: *mut *mut RtnetSender,
) -> i32 {
    guard("rtnet_sender_bind", || {
        // SAFETY: as the caller promises; so it is in all below.
        unsafe { write("sender", sender, core::ptr::null_mut()) }?;
        // SAFETY: as above.
        let mailbox = unsafe { exclusive("from", from) }?.free()?;
        let to = MailboxName(to);
        let failed = |error| Failure::Station(format!("{} to {to}", mailbox.name()), error);
        let bound = mailbox.sender(to).map_err(failed)?;
        // SAFETY: as above.
        unsafe { give("sender", sender, RtnetSender(bound)) }
    })
}

/// It is not needed any more.
///
/// # SAFETY
/// `sender` is NULL or a handle, and not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_sender_unbind(sender: *mut RtnetSender) {
    // SAFETY: as the caller promises.
    guard("rtnet_sender_unbind", || unsafe { give_back("sender", sender) });
}

/// Sends a package with an id of its own.
///
/// # SAFETY
/// `sender` is NULL or a handle that nobody else uses; `body` is NULL or so many bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_sender_send(
    sender: *mut RtnetSender,
    kind: i8,
    body: *const c_void,
    len: u32,
) -> i32 {
    guard("rtnet_sender_send", || {
        // SAFETY: as the caller promises.
        let (sender, body) = unsafe { (exclusive("sender", sender)?, bytes("body", body, len)?) };
        let sent = sender.0.send(kind, body);
        sent.map(i32::from).map_err(|error| Failure::Send(sender.0.to(), error))
    })
}

/// Sends a package with a head.
///
/// # SAFETY
/// As of [`rtnet_sender_send`]; `head` is NULL or a head.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_sender_send_with(
    sender: *mut RtnetSender,
    head: *const RtnetHead,
    body: *const c_void,
    len: u32,
) -> i32 {
    guard("rtnet_sender_send_with", || {
        // SAFETY: as the caller promises; so it is below.
        let (sender, body) = unsafe { (exclusive("sender", sender)?, bytes("body", body, len)?) };
        // SAFETY: as above.
        let head = unsafe { shared("head", head) }?.to_send()?;
        let sent = sender.0.send_with(&head, body);
        sent.map(|()| 0).map_err(|error| Failure::Send(sender.0.to(), error))
    })
}

/// How urgent what is sent is from now on.
///
/// # SAFETY
/// `sender` is NULL or a handle that nobody else uses.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_sender_set_priority(sender: *mut RtnetSender, priority: u8) -> i32 {
    guard("rtnet_sender_set_priority", || {
        // SAFETY: as the caller promises.
        unsafe { exclusive("sender", sender) }?.0.set_priority(priority);
        Ok(0)
    })
}
