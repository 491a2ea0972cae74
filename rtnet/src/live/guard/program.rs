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

/// What the frames of a guarded socket are marked with (SO_MARK): all others are others'. Positive as an `i32`,
/// as which a comparison takes it.
pub const MARK: u32 = u32::from_be_bytes(*b"RTnt");

/// Slots of the program.
pub const SLOTS: usize = 25;
const OTHERS: usize = 13;
const LATE: usize = 17;
const EARLY: usize = 21;

/// Offset of `mark` in `__sk_buff`.
const SKB_MARK: usize = 8;
const HELPER_KTIME_GET_NS: i32 = 5;
/// TCX_NEXT, which is TC_ACT_UNSPEC.
pub const NEXT: i32 = -1;
/// TCX_DROP, which is TC_ACT_SHOT.
pub const DROP: i32 = 2;

/// One slot of a program.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Instruction {
    code: u8,
    /// Destination in the lower four bits, source in the upper.
    registers: u8,
    offset: i16,
    immediate: i32,
}

/// A register: r0 is what a function returns, r1 its first argument, r6 outlives calls.
#[derive(Clone, Copy)]
struct Register(u8);

const R0: Register = Register(0);
const R1: Register = Register(1);
const R2: Register = Register(2);
const R6: Register = Register(6);

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

fn instruction(code: u8, to: Register, from: Register, offset: i16, immediate: i32) -> Instruction {
    Instruction { code, registers: to.0 | from.0 << 4, offset, immediate }
}

/// BPF_LDX | BPF_MEM | BPF_W
fn load_word(to: Register, from: Register, offset: usize) -> Instruction {
    instruction(0x61, to, from, offset as i16, 0)
}

/// BPF_LDX | BPF_MEM | BPF_DW
fn load(to: Register, from: Register, offset: usize) -> Instruction {
    instruction(0x79, to, from, offset as i16, 0)
}

/// BPF_LD | BPF_IMM | BPF_DW with BPF_PSEUDO_MAP_VALUE: the address of an array map's first value.
fn load_address(to: Register, map: i32) -> [Instruction; 2] {
    const PSEUDO_MAP_VALUE: Register = Register(2);
    [instruction(0x18, to, PSEUDO_MAP_VALUE, 0, map), instruction(0, R0, R0, 0, 0)]
}

/// BPF_JMP | BPF_JNE | BPF_K
fn jump_unless_equal(left: Register, right: i32, ahead: i16) -> Instruction {
    instruction(0x55, left, R0, ahead, right)
}

/// BPF_JMP | BPF_JLT | BPF_X, unsigned
fn jump_if_less(left: Register, right: Register, ahead: i16) -> Instruction {
    instruction(0xad, left, right, ahead, 0)
}

/// BPF_JMP | BPF_JGT | BPF_X, unsigned
fn jump_if_greater(left: Register, right: Register, ahead: i16) -> Instruction {
    instruction(0x2d, left, right, ahead, 0)
}

/// BPF_ALU64 | BPF_MOV | BPF_K
fn set(to: Register, value: i32) -> Instruction {
    instruction(0xb7, to, R0, 0, value)
}

/// BPF_STX | BPF_ATOMIC | BPF_DW with BPF_ADD
fn add_atomically(to: Register, offset: usize, what: Register) -> Instruction {
    instruction(0xdb, to, what, offset as i16, 0)
}

/// BPF_JMP | BPF_CALL
fn call(helper: i32) -> Instruction {
    instruction(0x85, R0, R0, 0, helper)
}

/// BPF_JMP | BPF_EXIT
fn exit() -> Instruction {
    instruction(0x95, R0, R0, 0, 0)
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
