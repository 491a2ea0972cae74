//! Mailboxes for programs in C: `include/rtnet_packages.h` says what each function does.
//!
//! Nothing here trusts what it is given but that a pointer which is not NULL is what the header asks for; and a panic ends here.

#![allow(unsafe_code)]

mod failure;
mod pointers;

use core::ffi::{CStr, c_char, c_void};
use core::ptr::NonNull;
use core::time::Duration;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use package_router::component::{Component, Mailbox, Package, Sender};
use package_router::mailbox::{LARGEST_BODY, Shape, TooSmall, WhenFull};
use package_router::name::MailboxName;
use package_router::wire::{Endian, Head};

use failure::Failure;
use pointers::{bytes, bytes_mut, exclusive, give, give_back, shared, write};

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

/// `struct rtnet_shape`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct RtnetShape {
    slots: u32,
    largest_body: u32,
    senders: u32,
    replace: u32,
}

// As the header says.
const _: () = assert!(size_of::<RtnetHead>() == 16 && size_of::<RtnetShape>() == 16);
const _: () = assert!(LARGEST_BODY == 262_128);

/// `rtnet_component`.
pub struct RtnetComponent(Component);

/// `rtnet_sender`.
pub struct RtnetSender(Sender);

/// `rtnet_mailbox`.
pub struct RtnetMailbox {
    name: MailboxName,
    /// Lent by the mailbox, which nobody uses as long as it is there.
    lent: Option<Package<'static>>,
    /// A box of it, of which a package may be lent while this is moved.
    mailbox: NonNull<Mailbox>,
}

impl RtnetMailbox {
    fn new(mailbox: Mailbox) -> Self {
        let name = mailbox.name();
        Self { name, lent: None, mailbox: NonNull::from(Box::leak(Box::new(mailbox))) }
    }

    /// The mailbox, unless a package is lent.
    fn free(&mut self) -> Result<&mut Mailbox, Failure> {
        if self.lent.is_some() {
            return Err(Failure::Lent(self.name));
        }
        // SAFETY: it is a box of this handle's own, which lives as long; no package of it is lent, so this is the only reference.
        Ok(unsafe { self.mailbox.as_mut() })
    }

    fn lent(&self) -> Result<&Package<'static>, Failure> {
        self.lent.as_ref().ok_or(Failure::NotLent(self.name))
    }

    fn take(&mut self) -> Result<Package<'static>, Failure> {
        self.lent.take().ok_or(Failure::NotLent(self.name))
    }
}

impl Drop for RtnetMailbox {
    fn drop(&mut self) {
        self.lent = None;
        // SAFETY: it was leaked from a box when this was made, is given back once, and nothing of it is lent.
        drop(unsafe { Box::from_raw(self.mailbox.as_ptr()) });
    }
}

/// Does something for a function of the header: what it returns. Whatever went wrong is kept for who asks.
fn guard(place: &'static str, what: impl FnOnce() -> Result<i32, Failure>) -> i32 {
    match catch_unwind(AssertUnwindSafe(what)) {
        Ok(Ok(told)) => told,
        Ok(Err(failure)) => failure::keep(place, failure),
        Err(payload) => {
            // To drop it might panic again.
            core::mem::forget(payload);
            failure::keep(place, Failure::Panicked)
        }
    }
}

/// What went wrong last in this thread.
#[unsafe(no_mangle)]
pub extern "C" fn rtnet_packages_error() -> *const c_char {
    catch_unwind(failure::words).unwrap_or(c"the library has panicked".as_ptr())
}

/// Comes to a station.
///
/// # Safety
/// `path` is NULL or a string, `component` NULL or the place of a pointer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_component_attach(
    path: *const c_char,
    component: *mut *mut RtnetComponent,
) -> i32 {
    guard("rtnet_component_attach", || {
        // SAFETY: as the caller promises.
        unsafe { write("component", component, core::ptr::null_mut()) }?;
        if path.is_null() {
            return Err(Failure::NoPointer("path"));
        }
        // SAFETY: it is not NULL, and so a string.
        let path = OsStr::from_bytes(unsafe { CStr::from_ptr(path) }.to_bytes());
        let failed = |error| Failure::Station(path.to_string_lossy().into_owned(), error);
        let attached = Component::attach(Path::new(path)).map_err(failed)?;
        // SAFETY: as the caller promises.
        unsafe { give("component", component, RtnetComponent(attached)) }
    })
}

/// Leaves it.
///
/// # Safety
/// `component` is NULL or a handle, and not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_component_detach(component: *mut RtnetComponent) {
    // SAFETY: as the caller promises.
    guard("rtnet_component_detach", || unsafe { give_back("component", component) });
}

/// A mailbox.
///
/// # Safety
/// `component` is NULL or a handle, `shape` NULL or a shape, `mailbox` NULL or the place of a pointer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_create(
    component: *mut RtnetComponent,
    name: u32,
    shape: *const RtnetShape,
    mailbox: *mut *mut RtnetMailbox,
) -> i32 {
    guard("rtnet_mailbox_create", || {
        // SAFETY: as the caller promises; so it is in all below.
        unsafe { write("mailbox", mailbox, core::ptr::null_mut()) }?;
        // SAFETY: as above.
        let component = unsafe { shared("component", component) }?;
        // SAFETY: as above.
        let RtnetShape { slots, largest_body, senders, replace } = *unsafe { shared("shape", shape) }?;
        let when_full = match replace {
            0 => WhenFull::Refuse,
            1 => WhenFull::Replace,
            other => return Err(Failure::Number("shape->replace", other)),
        };
        let [slots, largest_body, senders] = [slots, largest_body, senders].map(|number| number as usize);
        let shape = Shape { slots, largest_body, senders, when_full };
        let name = MailboxName(name);
        let failed = |error| Failure::Station(name.to_string(), error);
        let created = component.0.mailbox(name, shape).map_err(failed)?;
        // SAFETY: as above.
        unsafe { give("mailbox", mailbox, RtnetMailbox::new(created)) }
    })
}

/// It is not needed any more.
///
/// # Safety
/// `mailbox` is NULL or a handle, and not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_destroy(mailbox: *mut RtnetMailbox) {
    // SAFETY: as the caller promises.
    guard("rtnet_mailbox_destroy", || unsafe { give_back("mailbox", mailbox) });
}

/// A way from a mailbox to another.
///
/// # Safety
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
/// # Safety
/// `sender` is NULL or a handle, and not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_sender_unbind(sender: *mut RtnetSender) {
    // SAFETY: as the caller promises.
    guard("rtnet_sender_unbind", || unsafe { give_back("sender", sender) });
}

/// Sends a package with an id of its own.
///
/// # Safety
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
/// # Safety
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
        let RtnetHead { kind, priority, id, big_endian, .. } = *unsafe { shared("head", head) }?;
        let body_order = match big_endian {
            0 => Endian::Little,
            1 => Endian::Big,
            other => return Err(Failure::Number("head->big_endian", other.into())),
        };
        let head = Head { kind, priority, id, body_order, ..Head::default() };
        let sent = sender.0.send_with(&head, body);
        sent.map(|()| 0).map_err(|error| Failure::Send(sender.0.to(), error))
    })
}

/// How urgent what is sent is from now on.
///
/// # Safety
/// `sender` is NULL or a handle that nobody else uses.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_sender_set_priority(sender: *mut RtnetSender, priority: u8) -> i32 {
    guard("rtnet_sender_set_priority", || {
        // SAFETY: as the caller promises.
        unsafe { exclusive("sender", sender) }?.0.set_priority(priority);
        Ok(0)
    })
}

/// Copies the most urgent package.
///
/// # Safety
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
        let name = handle.name;
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
/// # Safety
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
        let name = handle.name;
        handle.free()?;
        // SAFETY: it is a box of this handle's own, whose address stays, and which lives longer than what is lent of it; nothing is lent
        // yet, and until this is given back nobody gets at it: see `free`.
        let lender: &'static mut Mailbox = unsafe { handle.mailbox.as_mut() };
        let package = receive(lender, name, timeout_ns)?;
        let len = package.body().len();
        if !head.is_null() {
            // SAFETY: as above.
            unsafe { write("head", head, RtnetHead::from(package.head())) }?;
        }
        handle.lent = Some(package);
        Ok(len as i32)
    })
}

/// Copies of the body that is lent.
///
/// # Safety
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
/// # Safety
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
/// # Safety
/// `mailbox` is NULL or a handle that nobody else uses.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_put_back(mailbox: *mut RtnetMailbox) -> i32 {
    guard("rtnet_mailbox_put_back", || {
        // SAFETY: as the caller promises.
        unsafe { exclusive("mailbox", mailbox) }?.take()?.put_back();
        Ok(0)
    })
}

/// Throws away what waits.
///
/// # Safety
/// `mailbox` is NULL or a handle that nobody else uses.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_clean(mailbox: *mut RtnetMailbox) -> i32 {
    guard("rtnet_mailbox_clean", || {
        // SAFETY: as the caller promises.
        let handle = unsafe { exclusive("mailbox", mailbox) }?;
        let name = handle.name;
        handle.free()?.clean().map(|count| count as i32).map_err(|error| Failure::Receive(name, error))
    })
}

/// How many wait.
///
/// # Safety
/// `mailbox` is NULL or a handle that nobody else uses.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_depth(mailbox: *mut RtnetMailbox) -> i32 {
    guard("rtnet_mailbox_depth", || {
        // SAFETY: as the caller promises.
        let handle = unsafe { exclusive("mailbox", mailbox) }?;
        let name = handle.name;
        handle.free()?.depth().map(|count| count as i32).map_err(|error| Failure::Receive(name, error))
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

#[cfg(test)]
mod tests {
    use super::*;
    use core::ptr::{null, null_mut};

    #[test]
    fn a_panic_ends_at_the_boundary_and_is_an_error() {
        assert_eq!(guard("there", || panic!("on purpose")), -libc::ENOTRECOVERABLE);
        let said = failure::said();
        assert!(said.starts_with("ENOTRECOVERABLE in there: the library has panicked"), "{said}");
        assert!(said.contains("destroy this handle"), "{said}");
        struct PanicsAgain;
        impl Drop for PanicsAgain {
            fn drop(&mut self) {
                panic!("again");
            }
        }
        let twice = || std::panic::resume_unwind(Box::new(PanicsAgain));
        assert_eq!(guard("there", twice), -libc::ENOTRECOVERABLE);
        assert_eq!(guard("there", || Ok(7)), 7);
    }

    /// What is NULL is refused by all, and said which it was; what is given back may be NULL.
    #[test]
    fn null_is_refused_everywhere_and_named() {
        let mut head = RtnetHead::default();
        let mut handle = null_mut();
        // SAFETY: NULL is refused, and all else is what it is said to be.
        let told = unsafe {
            rtnet_component_detach(null_mut());
            rtnet_mailbox_destroy(null_mut());
            rtnet_sender_unbind(null_mut());
            assert_eq!(failure::said(), "", "to give back nothing is nothing");
            let shape = RtnetShape { slots: 1, largest_body: 1, senders: 1, replace: 0 };
            let (body, room) = (null(), null_mut());
            [
                (rtnet_component_attach(null(), &mut null_mut()), "path", failure::said()),
                (rtnet_component_attach(c"x".as_ptr(), null_mut()), "component", failure::said()),
                (rtnet_mailbox_create(null_mut(), 1, &shape, &mut handle), "component", failure::said()),
                (rtnet_mailbox_create(null_mut(), 1, &shape, null_mut()), "mailbox", failure::said()),
                (rtnet_sender_bind(null_mut(), 1, &mut null_mut()), "from", failure::said()),
                (rtnet_sender_bind(null_mut(), 1, null_mut()), "sender", failure::said()),
                (rtnet_sender_send(null_mut(), 1, body, 0), "sender", failure::said()),
                (rtnet_sender_send_with(null_mut(), &head, body, 0), "sender", failure::said()),
                (rtnet_sender_set_priority(null_mut(), 1), "sender", failure::said()),
                (rtnet_mailbox_receive(null_mut(), &mut head, room, 0, 0), "mailbox", failure::said()),
                (rtnet_mailbox_peek(null_mut(), &mut head, 0), "mailbox", failure::said()),
                (rtnet_mailbox_body(null_mut(), 0, room, 0), "mailbox", failure::said()),
                (rtnet_mailbox_release(null_mut()), "mailbox", failure::said()),
                (rtnet_mailbox_put_back(null_mut()), "mailbox", failure::said()),
                (rtnet_mailbox_clean(null_mut()), "mailbox", failure::said()),
                (rtnet_mailbox_depth(null_mut()), "mailbox", failure::said()),
            ]
        };
        for (told, what, said) in told {
            assert_eq!(told, -libc::EINVAL, "{said}");
            assert!(said.contains(&format!(": `{what}` points nowhere")), "{what}: {said}");
        }
        assert!(handle.is_null());
    }

    #[test]
    fn what_went_wrong_is_said_to_the_thread_that_did_it() {
        assert_eq!(guard("here", || Err(Failure::NotLent(MailboxName(0x0012_0000)))), -libc::ENOMSG);
        let theirs = std::thread::spawn(failure::said);
        assert_eq!(theirs.join().unwrap(), "");
        assert_eq!(failure::said(), "ENOMSG in here: Odometry(0/0): no package is lent: peek at one first");
    }
}
