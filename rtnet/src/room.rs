//! Room that is made by one thread and filled by another, which must not wait for the kernel.

use core::hint::black_box;
use core::mem::MaybeUninit;

/// An empty vector for so many, whose memory is there: memory that was only reserved comes page by page when it is first
/// written, at the cost of who writes it.
pub fn vec<T>(capacity: usize) -> Vec<T> {
    // Hidden, or both would become an allocation of zeros, which touches nothing either.
    let mut room = black_box(Vec::with_capacity(capacity));
    for place in room.spare_capacity_mut() {
        *place = MaybeUninit::zeroed();
    }
    // Nobody reads what was written there: it is to be written all the same.
    black_box(room.as_mut_ptr());
    room
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::sys::resource::{UsageWho, getrusage};

    /// What it costs to fill it.
    fn faults(mut room: Vec<[u8; 64]>) -> i64 {
        let taken = || getrusage(UsageWho::RUSAGE_THREAD).unwrap().minor_page_faults();
        let before = taken();
        (0..room.capacity()).for_each(|_| room.push(black_box([1; 64])));
        taken() - before
    }

    #[test]
    fn room_that_was_made_is_filled_without_the_kernel() {
        // So much is always fresh from the kernel: of less, other tests may have left some.
        let capacity = (64 << 20) / 64;
        assert!(faults(Vec::with_capacity(capacity)) > 16, "else this shows nothing");
        assert_eq!(faults(vec(capacity)), 0);
    }
}
