//! The guard's program, assembled here: eBPF as linux/bpf.h numbers it.
//!
//! ```text
//!  0   1    r6 = &page                     a load of 64 bits takes two slots
//!  2        r2 = skb->mark                 r1 is the context
//!  3        if r2 != MARK goto OTHERS      somebody else's frame
//!  4        r0 = bpf_ktime_get_ns()
//!  5        r1 = page.begin
//!  6        if r0 < r1 goto EARLY
//!  7        r1 = page.end
//!  8        if r0 > r1 goto LATE
//!  9..12    page.passed += 1, r0 = -1, exit            whatever else is attached decides
//! 13..16    OTHERS: page.others += 1, r0 = page.verdict, exit
//! 17..20    LATE:   page.late += 1, r0 = 2, exit      dropped
//! 21..24    EARLY:  page.early += 1, r0 = 2, exit     dropped
//! ```
//!
//! The frame's length does not count: what may not happen is that a transmission *starts* late, and the
//! schedule has room for a frame's time on the air behind the window's end.

use core::mem::offset_of;

use super::Page;
use crate::live::bpf::assembler::*;

/// What the frames of a guarded socket are marked with (SO_MARK): all others are others'. Positive as an `i32`,
/// as which a comparison takes it.
pub const MARK: u32 = u32::from_be_bytes(*b"RTnt");

/// Slots of the program.
pub const SLOTS: usize = 25;
const OTHERS: usize = 13;
const LATE: usize = 17;
const EARLY: usize = 21;

/// The program, for the map behind this descriptor.
pub fn assemble(map: i32) -> [Instruction; SLOTS] {
    let [address, rest] = load_address(R6, map);
    [
        address,
        rest,
        load_word(R2, R1, SKB_MARK),
        jump_unless_equal(R2, MARK as i32, ahead(3, OTHERS)),
        call(HELPER_KTIME_GET_NS),
        load(R1, R6, offset_of!(Page, begin)),
        jump_if_less(R0, R1, ahead(6, EARLY)),
        load(R1, R6, offset_of!(Page, end)),
        jump_if_greater(R0, R1, ahead(8, LATE)),
        set(R1, 1),
        add_atomically(R6, offset_of!(Page, passed), R1),
        set(R0, NEXT),
        exit(),
        // OTHERS
        set(R1, 1),
        add_atomically(R6, offset_of!(Page, others), R1),
        load(R0, R6, offset_of!(Page, verdict)),
        exit(),
        // LATE
        set(R1, 1),
        add_atomically(R6, offset_of!(Page, late), R1),
        set(R0, DROP),
        exit(),
        // EARLY
        set(R1, 1),
        add_atomically(R6, offset_of!(Page, early), R1),
        set(R0, DROP),
        exit(),
    ]
}

/// What a jump in slot `from` adds to reach `label`: it counts from the slot after it.
fn ahead(from: usize, label: usize) -> i16 {
    (label - from - 1) as i16
}

/// A program that ends the chain with TCX_PASS, so that nothing behind it runs.
#[cfg(test)]
pub fn pass_everything() -> [Instruction; 2] {
    [set(R0, 0), exit()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_program_is_the_listing() {
        // Code, destination, source, offset, immediate, written down by hand.
        let listing = [
            (0x18, 6, 2, 0, 77),
            (0x00, 0, 0, 0, 0),
            (0x61, 2, 1, 8, 0),
            (0x55, 2, 0, 9, 0x5254_6e74),
            (0x85, 0, 0, 0, 5),
            (0x79, 1, 6, 0, 0),
            (0xad, 0, 1, 14, 0),
            (0x79, 1, 6, 8, 0),
            (0x2d, 0, 1, 8, 0),
            (0xb7, 1, 0, 0, 1),
            (0xdb, 6, 1, 16, 0),
            (0xb7, 0, 0, 0, -1),
            (0x95, 0, 0, 0, 0),
            (0xb7, 1, 0, 0, 1),
            (0xdb, 6, 1, 40, 0),
            (0x79, 0, 6, 48, 0),
            (0x95, 0, 0, 0, 0),
            (0xb7, 1, 0, 0, 1),
            (0xdb, 6, 1, 24, 0),
            (0xb7, 0, 0, 0, 2),
            (0x95, 0, 0, 0, 0),
            (0xb7, 1, 0, 0, 1),
            (0xdb, 6, 1, 32, 0),
            (0xb7, 0, 0, 0, 2),
            (0x95, 0, 0, 0, 0),
        ];
        let listing = listing.map(|(code, to, from, offset, immediate)| {
            instruction(code, Register(to), Register(from), offset, immediate)
        });
        assert_eq!(assemble(77), listing);
        assert_eq!(size_of::<Instruction>(), 8);
    }
}
