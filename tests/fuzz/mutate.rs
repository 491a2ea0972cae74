//! Small changes of bytes, of frames and of texts.

use rtnet::sim::Random;

/// What lengths, counts and offsets are when they lie.
const WORDS: [u16; 16] =
    [0, 1, 7, 8, 13, 20, 28, 0x5f, 0xff, 0x3fff, 0x7fff, 0x8000, 0x2000, 0x1fff, 0xfffe, 0xffff];
/// An input is no longer than this: a sequence of some dozen frames.
const LONGEST: usize = 1 << 16;

fn place(random: &mut Random, len: usize) -> usize {
    random.below(len as u64) as usize
}

/// A range of at most `most` bytes.
fn range(random: &mut Random, len: usize, most: usize) -> core::ops::Range<usize> {
    let begin = place(random, len + 1);
    begin..(begin + place(random, most + 1)).min(len)
}

/// One change of some bytes.
pub fn bytes(random: &mut Random, input: &mut Vec<u8>, other: &[u8]) {
    let at = place(random, input.len());
    let word = WORDS[place(random, WORDS.len())].to_be_bytes();
    match random.below(9) {
        0 => input.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= 1u8 << random.below(8)),
        1 => input.iter_mut().skip(at).take(1).for_each(|byte| *byte = random.bits() as u8),
        2 | 3 => input.iter_mut().skip(at).zip(word).for_each(|(byte, new)| *byte = new),
        4 => drop(input.drain(range(random, input.len(), 16))),
        5 => {
            let copied = input[range(random, input.len(), 32)].to_vec();
            input.splice(at..at, copied);
        }
        6 => {
            let of_other = &other[range(random, other.len(), other.len())];
            let end = (at + of_other.len()).min(input.len());
            input.splice(at..end, of_other.iter().copied());
        }
        7 => input.truncate(at),
        _ => input.extend((0..random.below(40)).map(|_| random.bits() as u8)),
    }
    input.truncate(LONGEST);
}

/// One change of a text: of its lines, words and numbers, or of its bytes.
pub fn text(random: &mut Random, input: &mut Vec<u8>, other: &[u8]) {
    const NUMBERS: [&str; 10] = [
        "0",
        "1",
        "-1",
        "255",
        "256",
        "65535",
        "4294967296",
        "9223372036854775807",
        "18446744073709551615",
        "1e308",
    ];
    let lines =
        |text: &[u8]| text.split_inclusive(|&byte| byte == b'\n').map(<[u8]>::to_vec).collect::<Vec<_>>();
    let (mut ours, theirs) = (lines(input), lines(other));
    let at = place(random, ours.len());
    match random.below(6) {
        0 if !ours.is_empty() => drop(ours.remove(at)),
        1 if !ours.is_empty() => ours.insert(at, ours[place(random, ours.len())].clone()),
        2 if !theirs.is_empty() => ours.insert(at, theirs[place(random, theirs.len())].clone()),
        3 | 4 => {
            let digits: Vec<usize> = (0..input.len()).filter(|&at| input[at].is_ascii_digit()).collect();
            let Some(&begin) = digits.get(place(random, digits.len())) else { return };
            let len = input[begin..].iter().take_while(|byte| byte.is_ascii_digit()).count();
            input.splice(begin..begin + len, NUMBERS[place(random, NUMBERS.len())].bytes());
            return;
        }
        _ => return bytes(random, input, other),
    }
    *input = ours.concat();
    input.truncate(LONGEST);
}
