//! Packages out of the bytes that a connection brings: joined and split anywhere.

use crate::wire::{HEAD_LEN, Head, HeadError};

/// Memory that an idle connection keeps for the next package that comes in pieces.
const KEPT: usize = 4 << 10;

/// The begin of a package whose end has not come yet.
#[derive(Debug, Default)]
pub struct Frames {
    begun: Vec<u8>,
}

impl Frames {
    /// Hands over each package that `bytes` complete: its head, and its body. A head that is none ends the connection: nothing
    /// says where the next package would begin. Memory grows with the bytes received, not with the length in a head.
    pub fn cut(&mut self, bytes: &[u8], mut each: impl FnMut(Head, &[u8])) -> Result<(), HeadError> {
        self.cut_runs(bytes, |head, body, _| {
            each(head, body);
            0
        })
    }

    /// The same, with the bytes behind the package: `each` returns how many of them it has taken, in whole packages.
    pub fn cut_runs(
        &mut self,
        mut bytes: &[u8],
        mut each: impl FnMut(Head, &[u8], &[u8]) -> usize,
    ) -> Result<(), HeadError> {
        if !self.begun.is_empty() {
            let Some(head) =
                self.filled(&mut bytes, HEAD_LEN).then(|| Head::parse(&self.begun)).transpose()?
            else {
                return Ok(());
            };
            if !self.filled(&mut bytes, head.len as usize) {
                return Ok(());
            }
            let taken = each(head, &self.begun[HEAD_LEN..], bytes);
            bytes = &bytes[taken..];
            self.begun.clear();
            self.begun.shrink_to(KEPT);
        }
        while bytes.len() >= HEAD_LEN {
            let head = Head::parse(bytes)?;
            let Some((package, rest)) = bytes.split_at_checked(head.len as usize) else { break };
            let taken = each(head, &package[HEAD_LEN..], rest);
            bytes = &rest[taken..];
        }
        self.begun.extend_from_slice(bytes);
        Ok(())
    }

    /// Bytes of the package that has begun.
    pub fn begun(&self) -> usize {
        self.begun.len()
    }

    /// Moves bytes until `len` are collected; returns whether all of them are there.
    fn filled(&mut self, bytes: &mut &[u8], len: usize) -> bool {
        let missing = len.saturating_sub(self.begun.len());
        let (now, rest) = bytes.split_at(missing.min(bytes.len()));
        self.begun.extend_from_slice(now);
        *bytes = rest;
        now.len() == missing
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::name::MailboxName;
    use crate::wire::{Endian, MAX_LEN};

    fn package(kind: i8, body: &[u8], head_order: Endian) -> Vec<u8> {
        let head = Head { head_order, ..Head::new(kind, MailboxName(1), MailboxName(2)) };
        [&head.with_body(body.len()).unwrap().to_bytes(), body].concat()
    }

    fn cut(frames: &mut Frames, bytes: &[u8]) -> Vec<(i8, Vec<u8>)> {
        let mut seen = Vec::new();
        frames.cut(bytes, |head, body| seen.push((head.kind, body.to_vec()))).unwrap();
        seen
    }

    #[test]
    fn packages_are_the_same_however_their_bytes_come() {
        let packages = [
            package(21, b"hello", Endian::Big),
            package(-6, &[], Endian::Little),
            package(3, &[7; 99], Endian::Big),
        ];
        let bytes = packages.concat();
        let whole = cut(&mut Frames::default(), &bytes);
        assert_eq!(
            whole.iter().map(|(kind, body)| (*kind, body.len())).collect::<Vec<_>>(),
            [(21, 5), (-6, 0), (3, 99)]
        );
        for at_once in 1..bytes.len() {
            let mut frames = Frames::default();
            let pieces: Vec<_> = bytes.chunks(at_once).flat_map(|piece| cut(&mut frames, piece)).collect();
            assert_eq!(pieces, whole, "{at_once} bytes at once");
            assert_eq!(frames.begun(), 0);
        }
    }

    #[test]
    fn the_longest_package_passes_and_a_longer_one_does_not() {
        let longest = package(1, &vec![3; MAX_LEN - HEAD_LEN], Endian::Little);
        assert_eq!(cut(&mut Frames::default(), &longest)[0].1.len(), MAX_LEN - HEAD_LEN);
        for len in [0, 15, MAX_LEN as u32 + 1, u32::MAX] {
            let mut head = Head::new(1, MailboxName(1), MailboxName(2)).to_bytes();
            head[12..].copy_from_slice(&len.to_le_bytes());
            for at_once in [1, HEAD_LEN] {
                let mut frames = Frames::default();
                let refused =
                    head.chunks(at_once).find_map(|piece| frames.cut(piece, |_, _| panic!("{len}")).err());
                // Byte by byte the refusal comes with the next one at the latest.
                assert!(
                    refused.is_some() || frames.cut(&[0], |_, _| ()).is_err(),
                    "{len}, {at_once} at once"
                );
            }
        }
    }

    #[test]
    fn an_announced_length_takes_no_memory() {
        let mut frames = Frames::default();
        let head = Head::new(1, MailboxName(1), MailboxName(2)).with_body(MAX_LEN - HEAD_LEN).unwrap();
        assert!(cut(&mut frames, &head.to_bytes()).is_empty());
        assert!(frames.begun.capacity() < 1_024, "{}", frames.begun.capacity());
    }
}
