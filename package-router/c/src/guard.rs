//! Where a panic ends, and what went wrong is told.

use core::ffi::c_char;
use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::failure::{self, Failure};

/// Does something for a function of the header: what it returns. Whatever went wrong is kept for who asks.
pub fn guard(place: &'static str, what: impl FnOnce() -> Result<i32, Failure>) -> i32 {
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

#[cfg(test)]
mod tests {
    use package_router::name::MailboxName;

    use super::*;

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

    #[test]
    fn what_went_wrong_is_said_to_the_thread_that_did_it() {
        assert_eq!(guard("here", || Err(Failure::NotLent(MailboxName(0x0012_0000)))), -libc::ENOMSG);
        let theirs = std::thread::spawn(failure::said);
        assert_eq!(theirs.join().unwrap(), "");
        assert_eq!(failure::said(), "ENOMSG in here: Odometry(0/0): no package is lent: peek at one first");
    }
}
