//! Taking packages out of a mailbox.

use core::ffi::c_void;
use core::time::Duration;

use package_router::component::{Mailbox, Package};
use package_router::mailbox::{LARGEST_BODY, TooSmall};
use package_router::name::MailboxName;

use crate::failure::Failure;
use crate::guard::guard;
use crate::heads::RtnetHead;
use crate::mailboxes::RtnetMailbox;
use crate::pointers::{bytes_mut, exclusive, write};

// As the header says.
const _: () = assert!(LARGEST_BODY == 262_128);

/// Copies the most urgent package.
///
/// # SAFETY
/// `mailbox` is NULL or a handle that nobody else uses; `head` is NULL or the place of a head; `body` NULL or room for so many bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_receive(
    mailbox: *mut RtnetMailbox,
    head: *mut RtnetHead,
    body: *mut c_void,
    room: u32,
    timeout_ns: i64,
) -> i32 {
    guard("rtnet_mailbox_receive", || {
        // SAFETY: as the caller promises; so it is below.
        let (handle, into) = unsafe { (exclusive("mailbox", mailbox)?, bytes_mut("body", body, room)?) };
        let name = handle.name();
        let package = receive(handle.free()?, name, timeout_ns)?;
        if !head.is_null() {
            // SAFETY: as above.
            unsafe { write("head", head, RtnetHead::from(package.head())) }?;
        }
        let (got, needed) = (into.len(), package.body().len());
        if needed > got {
            package.put_back();
            return Err(Failure::TooSmall(name, TooSmall { got, needed }));
        }
        Ok(package.body().copy_to(0, into) as i32)
    })
}

/// Lends the most urgent package.
///
/// # SAFETY
/// `mailbox` is NULL or a handle that nobody else uses; `head` is NULL or the place of a head.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_peek(
    mailbox: *mut RtnetMailbox,
    head: *mut RtnetHead,
    timeout_ns: i64,
) -> i32 {
    guard("rtnet_mailbox_peek", || {
        // SAFETY: as the caller promises; so it is below.
        let handle = unsafe { exclusive("mailbox", mailbox) }?;
        let name = handle.name();
        let lent = handle.lend(|lender| {
            let package = receive(lender, name, timeout_ns)?;
            if !head.is_null() {
                // SAFETY: as above.
                unsafe { write("head", head, RtnetHead::from(package.head())) }?;
            }
            Ok(package)
        });
        lent.map(|len| len as i32)
    })
}

/// Copies of the body that is lent.
///
/// # SAFETY
/// `mailbox` is NULL or a handle that nobody else uses; `into` is NULL or room for so many bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_body(
    mailbox: *mut RtnetMailbox,
    skip: u32,
    into: *mut c_void,
    room: u32,
) -> i32 {
    guard("rtnet_mailbox_body", || {
        // SAFETY: as the caller promises.
        let (handle, into) = unsafe { (exclusive("mailbox", mailbox)?, bytes_mut("into", into, room)?) };
        let body = handle.lent()?.body();
        let skip = (skip as usize).min(body.len());
        Ok(body.copy_to(skip, into) as i32)
    })
}

/// It is read.
///
/// # SAFETY
/// `mailbox` is NULL or a handle that nobody else uses.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_release(mailbox: *mut RtnetMailbox) -> i32 {
    guard("rtnet_mailbox_release", || {
        // SAFETY: as the caller promises.
        drop(unsafe { exclusive("mailbox", mailbox) }?.take()?);
        Ok(0)
    })
}

/// It stays.
///
/// # SAFETY
/// `mailbox` is NULL or a handle that nobody else uses.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_put_back(mailbox: *mut RtnetMailbox) -> i32 {
    guard("rtnet_mailbox_put_back", || {
        // SAFETY: as the caller promises.
        unsafe { exclusive("mailbox", mailbox) }?.take()?.put_back();
        Ok(0)
    })
}

fn receive(mailbox: &mut Mailbox, name: MailboxName, timeout_ns: i64) -> Result<Package<'_>, Failure> {
    let failed = |error| Failure::Receive(name, error);
    match u64::try_from(timeout_ns) {
        Ok(0) => mailbox.try_receive().map_err(failed)?.ok_or(Failure::Nothing(name)),
        Ok(nanos) => mailbox.receive(Some(Duration::from_nanos(nanos))).map_err(failed),
        Err(_) => mailbox.receive(None).map_err(failed),
    }
}
