//! The example frames of `vectors/rtnet-frames.json`.

/// One of them.
#[derive(Clone, Debug)]
pub struct Vector {
    /// As `rtnet-frames.md` counts them, from 1.
    pub number: usize,
    /// Its short name there.
    pub name: String,
    /// From the destination address on.
    pub bytes: Vec<u8>,
}

/// All of them, in order.
pub fn all() -> Vec<Vector> {
    let parsed: Vec<(String, u64, String)> =
        serde_json::from_str(include_str!("../vectors/rtnet-frames.json")).expect("the vectors are valid");
    let numbered = parsed.into_iter().enumerate();
    numbered.map(|(i, (name, _, hex))| Vector { number: i + 1, name, bytes: unhex(&hex) }).collect()
}

/// Vector `number`, counted from 1.
pub fn vector(number: usize) -> Vector {
    all().swap_remove(number - 1)
}

fn unhex(hex: &str) -> Vec<u8> {
    let digit = |i| u8::from_str_radix(&hex[i..i + 2], 16).expect("two hexadecimal digits");
    (0..hex.len()).step_by(2).map(digit).collect()
}
