//! Mailboxes, but for how packages are taken out of them.

use core::ptr::NonNull;

use package_router::component::{Mailbox, Package};
use package_router::mailbox::{Shape, WhenFull};
use package_router::name::MailboxName;

use crate::components::RtnetComponent;
use crate::failure::Failure;
use crate::guard::guard;
use crate::pointers::{exclusive, give, give_back, shared, write};

/// `struct rtnet_shape`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct RtnetShape {
    pub(crate) slots: u32,
    pub(crate) largest_body: u32,
    pub(crate) senders: u32,
    pub(crate) replace: u32,
}

// As the header says.
const _: () = assert!(size_of::<RtnetShape>() == 16);

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

    pub(crate) fn name(&self) -> MailboxName {
        self.name
    }

    /// The mailbox, unless a package is lent.
    pub(crate) fn free(&mut self) -> Result<&mut Mailbox, Failure> {
        if self.lent.is_some() {
            return Err(Failure::Lent(self.name));
        }
        // SAFETY: it is a box of this handle's own, which lives as long; no package of it is lent, so this is the only reference.
        Ok(unsafe { self.mailbox.as_mut() })
    }

    /// Keeps a package of it, of so many bytes, until it is taken; in between nobody gets at the mailbox.
    pub(crate) fn lend(
        &mut self,
        package_of: impl FnOnce(&'static mut Mailbox) -> Result<Package<'static>, Failure>,
    ) -> Result<usize, Failure> {
        self.free()?;
        // SAFETY: it is a box of this handle's own, whose address stays, and which lives longer than what is lent of it; nothing is lent
        // yet, and until this is taken nobody gets at it: see `free`.
        let package = package_of(unsafe { self.mailbox.as_mut() })?;
        let len = package.body().len();
        self.lent = Some(package);
        Ok(len)
    }

    pub(crate) fn lent(&self) -> Result<&Package<'static>, Failure> {
        self.lent.as_ref().ok_or(Failure::NotLent(self.name))
    }

    pub(crate) fn take(&mut self) -> Result<Package<'static>, Failure> {
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

/// A mailbox.
///
/// # SAFETY
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
/// # SAFETY
/// `mailbox` is NULL or a handle, and not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_destroy(mailbox: *mut RtnetMailbox) {
    // SAFETY: as the caller promises.
    guard("rtnet_mailbox_destroy", || unsafe { give_back("mailbox", mailbox) });
}

/// Throws away what waits.
///
/// # SAFETY
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
/// # SAFETY
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
