//! Coming to a station, and leaving it.

use core::ffi::{CStr, c_char};
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

use package_router::component::Component;
use package_router::mailbox::LARGEST_BODY;
use package_router::tcp::client::TcpOptions;
use package_router::tcp::keys::ClientKeys;

use crate::failure::Failure;
use crate::guard::guard;
use crate::pointers::{give, give_back, write};

/// `rtnet_component`.
pub struct RtnetComponent(pub(crate) Component);

/// Comes to a station.
///
/// # SAFETY
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

/// Comes to a TCP router, on a host without a station.
///
/// # SAFETY
/// `router` and `keys` are NULL or strings, `component` NULL or the place of a pointer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_component_of_router(
    router: *const c_char,
    keys: *const c_char,
    largest_body: u32,
    component: *mut *mut RtnetComponent,
) -> i32 {
    guard("rtnet_component_of_router", || {
        // SAFETY: as the caller promises.
        unsafe { write("component", component, core::ptr::null_mut()) }?;
        if router.is_null() {
            return Err(Failure::NoPointer("router"));
        }
        // SAFETY: it is not NULL, and so a string.
        let router = unsafe { CStr::from_ptr(router) }.to_string_lossy().into_owned();
        let mut options = TcpOptions::new(router.parse().map_err(Failure::Router)?);
        if !keys.is_null() {
            // SAFETY: it is not NULL, and so a string.
            let directory = OsStr::from_bytes(unsafe { CStr::from_ptr(keys) }.to_bytes());
            options.keys = Some(ClientKeys::read(Path::new(directory)).map_err(Failure::Keys)?);
        }
        match largest_body {
            0 => {}
            len if len as usize > LARGEST_BODY => return Err(Failure::Len("largest_body", len)),
            len => options.largest_body = len as usize,
        }
        let failed = |error| Failure::Station(router, error);
        let component_of = Component::of_router(&options).map_err(failed)?;
        // SAFETY: as the caller promises.
        unsafe { give("component", component, RtnetComponent(component_of)) }
    })
}

/// Leaves it.
///
/// # SAFETY
/// `component` is NULL or a handle, and not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_component_detach(component: *mut RtnetComponent) {
    // SAFETY: as the caller promises.
    guard("rtnet_component_detach", || unsafe { give_back("component", component) });
}
