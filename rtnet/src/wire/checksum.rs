//! The Internet checksum (RFC 1071): the one's complement of the one's complement sum of all 16-bit words.
//!
//! ```text
//! bytes       00 01  f2 03  f4 f5  f6 f7        an odd last byte is followed by a zero
//! words         0001 + f203 + f4f5 + f6f7 = 2ddf0
//! carry back    ddf0 + 2                  = ddf2
//! complement                                220d
//! ```
//!
//! The sum is the same in the other byte order, with its bytes swapped, and words of 32 bits give the same
//! as words of 16 once their halves are added. So bytes are taken four at a time, as the machine reads them.

/// A checksum of what comes in parts; a part may end in the middle of a word.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Checksum {
    sum: u16,
    /// The next byte is the second of its word.
    odd: bool,
}

/// The checksum of one part, as a number in host order; 0 over bytes that contain a right one.
pub fn checksum(bytes: &[u8]) -> u16 {
    let mut sum = Checksum::new();
    sum.add(bytes);
    sum.finish()
}

impl Checksum {
    /// That of nothing.
    pub const fn new() -> Self {
        Self { sum: 0, odd: false }
    }

    /// Takes what comes next.
    pub fn add(&mut self, bytes: &[u8]) {
        let part = sum(bytes);
        let part = if self.odd { part.swap_bytes() } else { part };
        self.sum = fold(u64::from(self.sum) + u64::from(part));
        self.odd ^= !bytes.len().is_multiple_of(2);
    }

    /// What is written in the field, as a number in host order.
    pub fn finish(self) -> u16 {
        !self.sum
    }
}

/// What a checksum field holds once whole words that it is over are others (RFC 1624); never 0, which may say that there is none.
pub fn replaced(field: u16, before: &[u8], after: &[u8]) -> u16 {
    match !fold(u64::from(!field) + u64::from(!sum(before)) + u64::from(sum(after))) {
        0 => 0xffff,
        field => field,
    }
}

/// The words of one part. Only more than 16 GiB would have a carry that gets lost.
fn sum(bytes: &[u8]) -> u16 {
    let (words, rest) = bytes.as_chunks();
    let mut last = [0; 4];
    last[..rest.len()].copy_from_slice(rest);
    let words = words.iter().chain([&last]);
    u16::from_be(fold(words.map(|&word| u64::from(u32::from_ne_bytes(word))).sum()))
}

/// The carries, added until there is none.
fn fold(mut sum: u64) -> u16 {
    while sum > u64::from(u16::MAX) {
        sum = (sum & 0xffff) + (sum >> 16);
    }
    sum as u16
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The example of RFC 1071, section 3.
    const EXAMPLE: [u8; 8] = [0x00, 0x01, 0xf2, 0x03, 0xf4, 0xf5, 0xf6, 0xf7];

    /// Word by word.
    fn naive(bytes: &[u8]) -> u16 {
        let word = |pair: &[u8]| u32::from(pair[0]) << 8 | pair.get(1).map_or(0, |&low| u32::from(low));
        let add = |sum: u32, pair| (sum + word(pair)) % 0x1_0000 + (sum + word(pair)) / 0x1_0000;
        !(bytes.chunks(2).fold(0, add) as u16)
    }

    #[test]
    fn the_example_of_the_rfc_sums_to_what_it_says() {
        assert_eq!(checksum(&EXAMPLE), !0xddf2);
        assert_eq!(checksum(&EXAMPLE[..7]), !0xdcfb, "a zero follows the odd byte");
        let whole = [&EXAMPLE[..], &checksum(&EXAMPLE).to_be_bytes()].concat();
        assert_eq!(checksum(&whole), 0, "with the right checksum inside");
    }

    #[test]
    fn of_nothing_and_of_zeros_all_bits_are_set_and_of_ones_none() {
        assert_eq!((Checksum::new().finish(), checksum(&[]), checksum(&[0; 1500])), (0xffff, 0xffff, 0xffff));
        assert_eq!((checksum(&[0xff; 2]), checksum(&[0xff; 65_534])), (0, 0));
    }

    proptest! {
        #[test]
        fn parts_of_any_length_give_what_word_by_word_gives(
            bytes in prop::collection::vec(any::<u8>(), 0..2000),
            cuts in prop::collection::vec(any::<prop::sample::Index>(), 0..6),
        ) {
            prop_assert_eq!(checksum(&bytes), naive(&bytes));
            let mut cuts: Vec<usize> = cuts.iter().map(|cut| cut.index(bytes.len() + 1)).collect();
            cuts.sort_unstable();
            let (mut sum, mut from) = (Checksum::new(), 0);
            for to in cuts.into_iter().chain([bytes.len()]) {
                sum.add(&bytes[from..to]);
                from = to;
            }
            prop_assert_eq!(sum.finish(), naive(&bytes));
        }

        #[test]
        fn words_that_are_replaced_give_the_checksum_of_what_there_is_then(
            around in prop::collection::vec(any::<u16>(), 0..9),
            before in any::<[u8; 8]>(), after in any::<[u8; 8]>(),
        ) {
            let around: Vec<u8> = around.iter().flat_map(|word| word.to_be_bytes()).collect();
            let of = |words: &[u8]| match checksum(&[&around, words].concat()) {
                0 => 0xffff,
                sum => sum,
            };
            prop_assert_eq!(replaced(of(&before), &before, &after), of(&after));
        }

        #[test]
        fn every_single_bit_that_is_changed_is_noticed(
            mut bytes in prop::collection::vec(any::<u8>(), 1..200),
            at in any::<prop::sample::Index>(),
            bit in 0u8..8,
        ) {
            let before = checksum(&bytes);
            let at = at.index(bytes.len());
            bytes[at] ^= 1u8 << bit;
            prop_assert_ne!(checksum(&bytes), before);
        }
    }
}
