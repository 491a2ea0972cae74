//! Pointers of C, as far as they can be checked.

use core::ffi::c_void;

use package_router::mailbox::LARGEST_BODY;

use crate::failure::Failure;

/// What a handle or a struct is, to be read.
///
/// # SAFETY
/// `pointer` is NULL or one of that type, which nobody writes meanwhile.
pub unsafe fn shared<'a, T>(what: &'static str, pointer: *const T) -> Result<&'a T, Failure> {
    check(what, pointer)?;
    // SAFETY: it is not NULL, and so what the caller promises.
    Ok(unsafe { &*pointer })
}

/// What a handle is.
///
/// # SAFETY
/// `pointer` is NULL or one of that type, which nobody else uses meanwhile.
pub unsafe fn exclusive<'a, T>(what: &'static str, pointer: *mut T) -> Result<&'a mut T, Failure> {
    check(what, pointer)?;
    // SAFETY: it is not NULL, and so what the caller promises.
    Ok(unsafe { &mut *pointer })
}

/// Writes something where the caller wants it.
///
/// # SAFETY
/// `place` is NULL or one of that type; what is there is not dropped.
pub unsafe fn write<T>(what: &'static str, place: *mut T, value: T) -> Result<(), Failure> {
    check(what, place)?;
    // SAFETY: it is not NULL, and so what the caller promises.
    unsafe { place.write(value) };
    Ok(())
}

/// Makes a handle.
///
/// # SAFETY
/// As of [`write`].
pub unsafe fn give<T>(what: &'static str, place: *mut *mut T, handle: T) -> Result<i32, Failure> {
    check(what, place)?;
    // SAFETY: as the caller promises.
    unsafe { write(what, place, Box::into_raw(Box::new(handle))) }?;
    Ok(0)
}

/// Ends a handle; NULL is none.
///
/// # SAFETY
/// It is of [`give`], and not used any more.
pub unsafe fn give_back<T>(what: &'static str, handle: *mut T) -> Result<i32, Failure> {
    if !handle.is_null() {
        check(what, handle)?;
        // SAFETY: as the caller promises.
        drop(unsafe { Box::from_raw(handle) });
    }
    Ok(0)
}

/// A body that is to be sent. NULL is one without bytes.
///
/// # SAFETY
/// `pointer` is NULL or so many bytes that nobody writes meanwhile.
pub unsafe fn bytes<'a>(what: &'static str, pointer: *const c_void, len: u32) -> Result<&'a [u8], Failure> {
    if len as usize > LARGEST_BODY {
        return Err(Failure::Len("len", len));
    }
    match (pointer.is_null(), len) {
        (_, 0) => Ok(&[]),
        (true, _) => Err(Failure::NoPointer(what)),
        // SAFETY: it is not NULL, and so what the caller promises; it is no longer than a body.
        _ => Ok(unsafe { core::slice::from_raw_parts(pointer.cast(), len as usize) }),
    }
}

/// Room for a body, of which no more is used than the largest one takes. NULL is none.
///
/// # SAFETY
/// `pointer` is NULL or so many bytes that nobody else uses meanwhile.
pub unsafe fn bytes_mut<'a>(
    what: &'static str,
    pointer: *mut c_void,
    room: u32,
) -> Result<&'a mut [u8], Failure> {
    // That was a negative number.
    if i32::try_from(room).is_err() {
        return Err(Failure::Len("room", room));
    }
    match (pointer.is_null(), room) {
        (_, 0) => Ok(&mut []),
        (true, _) => Err(Failure::NoPointer(what)),
        _ => {
            let room = (room as usize).min(LARGEST_BODY);
            // SAFETY: it is not NULL, and so what the caller promises; bytes are written there, and none is read.
            Ok(unsafe { core::slice::from_raw_parts_mut(pointer.cast(), room) })
        }
    }
}

fn check<T>(what: &'static str, pointer: *const T) -> Result<(), Failure> {
    if pointer.is_null() || !pointer.is_aligned() { Err(Failure::NoPointer(what)) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wild_lengths_and_pointers_are_refused() {
        let mut room = [7u8; 4];
        let (read, written) = (room.as_ptr().cast(), room.as_mut_ptr().cast());
        // SAFETY: what is NULL, or too long, is refused; the rest is there.
        unsafe {
            assert_eq!(bytes("body", read, 4).unwrap(), [7; 4]);
            assert_eq!(bytes("body", core::ptr::null(), 0).unwrap(), []);
            assert!(matches!(bytes("body", core::ptr::null(), 1), Err(Failure::NoPointer("body"))));
            for len in [LARGEST_BODY as u32 + 1, i32::MAX as u32, u32::MAX] {
                assert!(matches!(bytes("body", read, len), Err(Failure::Len("len", wild)) if wild == len));
            }
            assert!(bytes_mut("body", core::ptr::null_mut(), 0).unwrap().is_empty());
            assert!(matches!(bytes_mut("body", core::ptr::null_mut(), 1), Err(Failure::NoPointer("body"))));
            assert!(matches!(bytes_mut("body", written, u32::MAX), Err(Failure::Len("room", u32::MAX))));
            assert!(bytes_mut("body", written, 1 << 31).is_err());
            assert_eq!(bytes_mut("body", written, 4).unwrap().len(), 4);
        }
        let odd = core::ptr::without_provenance::<u32>(5);
        assert!(matches!(check("shape", odd), Err(Failure::NoPointer("shape"))));
    }
}
