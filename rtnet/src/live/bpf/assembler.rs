//! Programs slot by slot: eBPF as linux/bpf.h numbers it.

/// Offsets in `__sk_buff`.
pub const SKB_LEN: usize = 0;
pub const SKB_MARK: usize = 8;
pub const SKB_PROTOCOL: usize = 16;
pub const SKB_INTERFACE: usize = 40;

pub const HELPER_KTIME_GET_NS: i32 = 5;
pub const HELPER_RANDOM: i32 = 7;
pub const HELPER_STORE_BYTES: i32 = 9;
pub const HELPER_CLONE_REDIRECT: i32 = 13;
pub const HELPER_LOAD_BYTES: i32 = 26;

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

/// A register: r0 is what a function returns, r1 to r5 its arguments, r6 to r9 outlive calls, r10 is the stack's end.
#[derive(Clone, Copy)]
pub struct Register(pub u8);

pub const R0: Register = Register(0);
pub const R1: Register = Register(1);
pub const R2: Register = Register(2);
pub const R3: Register = Register(3);
pub const R4: Register = Register(4);
pub const R5: Register = Register(5);
pub const R6: Register = Register(6);
pub const R7: Register = Register(7);
pub const R8: Register = Register(8);
pub const R9: Register = Register(9);
pub const R10: Register = Register(10);

pub fn instruction(code: u8, to: Register, from: Register, offset: i16, immediate: i32) -> Instruction {
    Instruction { code, registers: to.0 | from.0 << 4, offset, immediate }
}

/// BPF_LDX | BPF_MEM | BPF_B
pub fn load_byte(to: Register, from: Register, offset: i16) -> Instruction {
    instruction(0x71, to, from, offset, 0)
}

/// BPF_LDX | BPF_MEM | BPF_W
pub fn load_word(to: Register, from: Register, offset: usize) -> Instruction {
    instruction(0x61, to, from, offset as i16, 0)
}

/// BPF_LDX | BPF_MEM | BPF_DW
pub fn load(to: Register, from: Register, offset: usize) -> Instruction {
    instruction(0x79, to, from, offset as i16, 0)
}

/// BPF_LD | BPF_IMM | BPF_DW with BPF_PSEUDO_MAP_VALUE: the address of an array map's first value.
pub fn load_address(to: Register, map: i32) -> [Instruction; 2] {
    const PSEUDO_MAP_VALUE: Register = Register(2);
    [instruction(0x18, to, PSEUDO_MAP_VALUE, 0, map), instruction(0, R0, R0, 0, 0)]
}

/// BPF_STX | BPF_MEM | BPF_B
pub fn store_byte(to: Register, offset: i16, what: Register) -> Instruction {
    instruction(0x73, to, what, offset, 0)
}

/// BPF_STX | BPF_MEM | BPF_W
pub fn store_word(to: Register, offset: usize, what: Register) -> Instruction {
    instruction(0x63, to, what, offset as i16, 0)
}

/// BPF_JMP | BPF_JEQ | BPF_K
pub fn jump_if_equal(left: Register, right: i32, ahead: i16) -> Instruction {
    instruction(0x15, left, R0, ahead, right)
}

/// BPF_JMP | BPF_JNE | BPF_K
pub fn jump_unless_equal(left: Register, right: i32, ahead: i16) -> Instruction {
    instruction(0x55, left, R0, ahead, right)
}

/// BPF_JMP | BPF_JEQ | BPF_X
pub fn jump_if_same(left: Register, right: Register, ahead: i16) -> Instruction {
    instruction(0x1d, left, right, ahead, 0)
}

/// BPF_JMP | BPF_JLT | BPF_X, unsigned
pub fn jump_if_less(left: Register, right: Register, ahead: i16) -> Instruction {
    instruction(0xad, left, right, ahead, 0)
}

/// BPF_JMP | BPF_JGE | BPF_X, unsigned
pub fn jump_unless_less(left: Register, right: Register, ahead: i16) -> Instruction {
    instruction(0x3d, left, right, ahead, 0)
}

/// BPF_JMP | BPF_JGT | BPF_X, unsigned
pub fn jump_if_greater(left: Register, right: Register, ahead: i16) -> Instruction {
    instruction(0x2d, left, right, ahead, 0)
}

/// BPF_ALU64 | BPF_MOV | BPF_K
pub fn set(to: Register, value: i32) -> Instruction {
    instruction(0xb7, to, R0, 0, value)
}

/// BPF_ALU64 | BPF_MOV | BPF_X
pub fn copy(to: Register, from: Register) -> Instruction {
    instruction(0xbf, to, from, 0, 0)
}

/// BPF_ALU64 | BPF_ADD | BPF_K
pub fn add(to: Register, value: i32) -> Instruction {
    instruction(0x07, to, R0, 0, value)
}

/// BPF_ALU64 | BPF_ADD | BPF_X
pub fn add_register(to: Register, what: Register) -> Instruction {
    instruction(0x0f, to, what, 0, 0)
}

/// BPF_ALU64 | BPF_MOD | BPF_X, unsigned
pub fn remainder(of: Register, by: Register) -> Instruction {
    instruction(0x9f, of, by, 0, 0)
}

/// BPF_ALU64 | BPF_AND | BPF_K
pub fn and(to: Register, bits: i32) -> Instruction {
    instruction(0x57, to, R0, 0, bits)
}

/// BPF_ALU64 | BPF_OR | BPF_K
pub fn or(to: Register, bits: i32) -> Instruction {
    instruction(0x47, to, R0, 0, bits)
}

/// BPF_ALU64 | BPF_XOR | BPF_X
pub fn exclusive_or(to: Register, bits: Register) -> Instruction {
    instruction(0xaf, to, bits, 0, 0)
}

/// BPF_ALU64 | BPF_LSH | BPF_K
pub fn shift_left(to: Register, by: i32) -> Instruction {
    instruction(0x67, to, R0, 0, by)
}

/// BPF_ALU64 | BPF_LSH | BPF_X
pub fn shift_left_by(to: Register, by: Register) -> Instruction {
    instruction(0x6f, to, by, 0, 0)
}

/// BPF_ALU64 | BPF_RSH | BPF_K
pub fn shift_right(to: Register, by: i32) -> Instruction {
    instruction(0x77, to, R0, 0, by)
}

/// BPF_STX | BPF_ATOMIC | BPF_DW with BPF_ADD
pub fn add_atomically(to: Register, offset: usize, what: Register) -> Instruction {
    instruction(0xdb, to, what, offset as i16, 0)
}

/// The same with BPF_FETCH: `what` becomes what was there before.
pub fn fetch_and_add(to: Register, offset: usize, what: Register) -> Instruction {
    instruction(0xdb, to, what, offset as i16, 1)
}

/// BPF_JMP | BPF_CALL
pub fn call(helper: i32) -> Instruction {
    instruction(0x85, R0, R0, 0, helper)
}

/// BPF_JMP | BPF_EXIT
pub fn exit() -> Instruction {
    instruction(0x95, R0, R0, 0, 0)
}
