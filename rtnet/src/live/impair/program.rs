//! The two programs of an impaired wire, assembled here.
//!
//! ```text
//! ingress   what the station sends: mark = its side of a cut | what is to become of it, by `page.sends`
//! egress    what it is to hear:     fate = mark | LOST if the side is another's | by `page.hears`
//!             AGAIN                 a copy that was made here: it passes
//!             LOST                  written down, counted, dropped
//!             CORRUPT               a bit is turned, any; of an RTmac frame it is written down what it was
//!             TWICE                 a copy is sent by the same port
//! ```
//!
//! What a sender's wire loses is dropped at every receiver's, not before the bridge: whoever listens there sees it, as
//! an observer of a medium does.

use core::mem::offset_of;

use super::{LOG, LOG_ENTRY, LOGGED, OTHER_SIDE, Page, Thresholds};
use crate::live::bpf::assembler::*;
use crate::wire::ethernet::EtherType;

const LOST: i32 = 1;
const CORRUPT: i32 = 2;
const TWICE: i32 = 4;
const AGAIN: i32 = 0x80;
/// On the stack: the bit that is turned, and the byte that has it.
const BIT: i16 = -16;
const BYTE: i16 = -8;

/// At the ingress of a station's port, for the map behind this descriptor.
pub fn sends(map: i32) -> Vec<Instruction> {
    [
        begin(map),
        vec![load(R8, R7, offset_of!(Page, side))],
        draw(offset_of!(Page, sends)),
        vec![store_word(R6, SKB_MARK, R8), set(R0, NEXT), exit()],
    ]
    .concat()
}

/// At its egress.
pub fn hears(map: i32) -> Vec<Instruction> {
    let pass = vec![set(R0, NEXT), exit()];
    [
        begin(map),
        vec![load_word(R8, R6, SKB_MARK)],
        when(AGAIN, &pass),
        vec![
            load(R1, R7, offset_of!(Page, side)),
            copy(R2, R8),
            and(R2, OTHER_SIDE as i32),
            jump_if_same(R1, R2, 1),
            or(R8, LOST),
        ],
        draw(offset_of!(Page, hears)),
        when(LOST, &lose()),
        when(CORRUPT, &corrupt()),
        when(TWICE, &double()),
        pass,
    ]
    .concat()
}

/// r6 is the frame and r7 the page from here on; r8 is to be its fate.
fn begin(map: i32) -> Vec<Instruction> {
    let [address, rest] = load_address(R7, map);
    vec![copy(R6, R1), address, rest]
}

/// Adds to r8 what becomes of the frame by these thresholds.
fn draw(thresholds: usize) -> Vec<Instruction> {
    let at = |which: usize| load(R9, R7, thresholds + which);
    let happens = |bit| [call(HELPER_RANDOM), jump_unless_less(R0, R9, 1), or(R8, bit)];
    let mut draw = vec![
        load_word(R1, R6, SKB_PROTOCOL),
        at(offset_of!(Thresholds, lose_data)),
        jump_unless_equal(R1, control(), 1),
        at(offset_of!(Thresholds, lose_control)),
    ];
    draw.extend(happens(LOST));
    draw.push(at(offset_of!(Thresholds, corrupt)));
    draw.extend(happens(CORRUPT));
    draw.push(at(offset_of!(Thresholds, duplicate)));
    draw.extend(happens(TWICE));
    draw
}

/// What `protocol` of an RTmac frame is.
fn control() -> i32 {
    EtherType::RTMAC.0.to_be().into()
}

/// Does this if r8 has the bit.
fn when(bit: i32, then: &[Instruction]) -> Vec<Instruction> {
    let test = [copy(R1, R8), and(R1, bit), jump_if_equal(R1, 0, then.len() as i16)];
    [&test, then].concat()
}

/// Writes down which frame it is, for who judges needs to know.
fn write_down() -> Vec<Instruction> {
    vec![
        set(R5, 1),
        fetch_and_add(R7, offset_of!(Page, begun), R5),
        and(R5, LOG as i32 - 1),
        shift_left(R5, LOG_ENTRY.trailing_zeros() as i32),
        copy(R1, R6),
        set(R2, 0),
        copy(R3, R7),
        add_register(R3, R5),
        add(R3, offset_of!(Page, log) as i32),
        set(R4, LOGGED as i32),
        call(HELPER_LOAD_BYTES),
        set(R1, 1),
        add_atomically(R7, offset_of!(Page, written), R1),
    ]
}

/// Writes the frame down, counts it, and drops it.
fn lose() -> Vec<Instruction> {
    let count_and_drop = vec![
        set(R1, 1),
        load_word(R2, R6, SKB_PROTOCOL),
        jump_unless_equal(R2, control(), 1),
        add_atomically(R7, offset_of!(Page, lost_control), R1),
        jump_if_equal(R2, control(), 1),
        add_atomically(R7, offset_of!(Page, lost_data), R1),
        set(R0, DROP),
        exit(),
    ];
    [write_down(), count_and_drop].concat()
}

/// Turns one bit, any. What an RTmac frame was before is written down: it is as good as lost.
fn corrupt() -> Vec<Instruction> {
    let byte = |helper| {
        [
            copy(R1, R6),
            copy(R2, R9),
            copy(R3, R10),
            add(R3, BYTE.into()),
            set(R4, 1),
            set(R5, 0),
            call(helper),
        ]
    };
    let mut corrupt = vec![
        call(HELPER_RANDOM),
        copy(R9, R0),
        // The last three of its bits say which of a byte, the others which byte.
        and(R0, 7),
        set(R1, 1),
        shift_left_by(R1, R0),
        store_byte(R10, BIT, R1),
        shift_right(R9, 3),
        load_word(R1, R6, SKB_LEN),
        remainder(R9, R1),
    ];
    let write_down = write_down();
    // What fills a frame says nothing.
    corrupt.extend([
        load_word(R1, R6, SKB_PROTOCOL),
        jump_unless_equal(R1, control(), write_down.len() as i16 + 2),
        set(R1, LOGGED as i32),
        jump_unless_less(R9, R1, write_down.len() as i16),
    ]);
    corrupt.extend(write_down);
    corrupt.extend(byte(HELPER_LOAD_BYTES));
    corrupt.extend([
        load_byte(R1, R10, BYTE),
        load_byte(R2, R10, BIT),
        exclusive_or(R1, R2),
        store_byte(R10, BYTE, R1),
    ]);
    corrupt.extend(byte(HELPER_STORE_BYTES));
    corrupt.extend([set(R1, 1), add_atomically(R7, offset_of!(Page, corrupted), R1)]);
    corrupt
}

/// Sends a copy by the same port, which comes by here again.
fn double() -> Vec<Instruction> {
    vec![
        set(R1, AGAIN),
        store_word(R6, SKB_MARK, R1),
        copy(R1, R6),
        load_word(R2, R6, SKB_INTERFACE),
        set(R3, 0),
        call(HELPER_CLONE_REDIRECT),
        jump_unless_equal(R0, 0, 2),
        set(R1, 1),
        add_atomically(R7, offset_of!(Page, duplicated), R1),
    ]
}
