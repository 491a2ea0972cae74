//! Inputs that are sequences: what happens, one after the other, each step with some bytes.
//!
//! ```text
//! +------+----------+---------+----------- ... -+------
//! | kind | argument | length  | bytes           | kind        a length beyond the end says: what is left
//! +------+----------+---------+----------- ... -+------
//! ```

use rtnet::buf::ROOM;
use rtnet::sim::Random;

use super::{frames, mutate};

/// One thing that happens.
#[derive(Clone, Debug)]
pub struct Step {
    pub kind: u8,
    pub argument: u8,
    pub bytes: Vec<u8>,
}

/// Steps of one sequence at the most: as many frames may wait for a station that is about to send.
const MOST: usize = 48;

pub fn read(mut input: &[u8]) -> Vec<Step> {
    let mut steps = Vec::new();
    while let Some((&[kind, argument, high, low], rest)) = input.split_first_chunk::<4>() {
        if steps.len() == MOST {
            break;
        }
        let len = usize::from(u16::from_be_bytes([high, low])).min(rest.len()).min(ROOM);
        let (bytes, behind) = rest.split_at(len);
        steps.push(Step { kind, argument, bytes: bytes.to_vec() });
        input = behind;
    }
    steps
}

pub fn write(steps: &[Step]) -> Vec<u8> {
    let write = |step: &Step| {
        let [high, low] = (step.bytes.len() as u16).to_be_bytes();
        [&[step.kind, step.argument, high, low], &step.bytes[..]].concat()
    };
    steps.iter().flat_map(write).collect()
}

/// One change of a sequence: of its order, of a step, or of a step's bytes.
pub fn change(random: &mut Random, input: &mut Vec<u8>, other: &[u8]) {
    let (mut steps, others) = (read(input), read(other));
    let pick = |random: &mut Random, len: usize| random.below(len as u64) as usize;
    let at = pick(random, steps.len());
    let bytes_of_other =
        others.get(pick(random, others.len())).map(|step| step.bytes.clone()).unwrap_or_default();
    match random.below(10) {
        0 if !steps.is_empty() => drop(steps.remove(at)),
        1 if !steps.is_empty() => {
            let repeated = steps[pick(random, steps.len())].clone();
            steps.insert(at, repeated);
        }
        2 if !steps.is_empty() => {
            let with = pick(random, steps.len());
            steps.swap(at, with);
        }
        3 if !others.is_empty() => {
            let from = pick(random, others.len());
            steps.splice(at..at, others[from..].iter().take(1 + pick(random, 8)).cloned());
        }
        4 => steps.iter_mut().skip(at).take(1).for_each(|step| step.argument = random.bits() as u8),
        5 => steps.iter_mut().skip(at).take(1).for_each(|step| step.kind = random.bits() as u8),
        6 => return mutate::bytes(random, input, other),
        _ => {
            if let Some(step) = steps.get_mut(at) {
                frames::change(random, &mut step.bytes, &bytes_of_other);
            }
        }
    }
    steps.truncate(MOST);
    *input = write(&steps);
}
