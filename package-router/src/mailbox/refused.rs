//! Commands that find no slot in a mailbox that answers them: the sender keeps their heads in its segment, and the owner takes them.

use super::inbox::{Inbox, Lane};
use super::layout::{HEAD, MOST_KEPT, of_lane, of_owner, of_sender};
use super::sender::{LaneSender, SendError};
use super::shape::WhenFull;
use super::word::{Segment, Word};
use crate::wire::{HEAD_LEN, Head};

impl<Own: Segment, Theirs: Segment> LaneSender<Own, Theirs> {
    /// Keeps a refused command for the owner to answer. Returns whether the owner sleeps and is to be woken. The refusal stays if the
    /// package is no command, if the owner answers none, and while 256 wait to be answered, as many as there are ids.
    #[cold]
    pub(super) fn keep_command(&mut self, head: &Head, refusal: SendError) -> Result<bool, SendError> {
        let Self { own, theirs, layout, lane, .. } = self;
        let is_full = matches!(refusal, SendError::Full(_));
        if !is_full || layout.when_full != WhenFull::Answer || !head.is_command() {
            return Err(refusal);
        }
        let answered = theirs.at(layout.lane(*lane) + of_lane::ANSWERED).get_acquire();
        let kept = own.at(of_sender::KEPT).get();
        if kept.wrapping_sub(answered) >= MOST_KEPT as u64 {
            return Err(refusal);
        }
        write_head(own.part(layout.kept(kept), HEAD), &Head { len: HEAD_LEN as u32, ..*head });
        own.at(of_sender::KEPT).set_release(kept.wrapping_add(1));
        // As with a package: either it is seen here that the owner sleeps, or the owner sees the command.
        Own::Word::fence();
        Ok(theirs.at(of_owner::ASLEEP).get() != 0)
    }
}

impl<Own: Segment, Theirs: Segment> Inbox<Own, Theirs> {
    /// Takes the heads of all commands that were refused before this call, in a mailbox that [answers](WhenFull::Answer) them. The caller
    /// answers them.
    pub fn take_refused_commands(&mut self, heads: &mut Vec<Head>) {
        for lane in 0..self.used {
            if self.keeps_commands(lane) {
                self.take_commands_of(lane, heads);
            }
        }
    }

    fn take_commands_of(&mut self, lane: usize, heads: &mut Vec<Head>) {
        let Lane { sender, answered, .. } = &mut self.lanes[lane];
        let Some(sender) = sender else { return };
        let kept = sender.segment.at(of_sender::KEPT).get_acquire();
        if kept.wrapping_sub(*answered) > MOST_KEPT as u64 {
            sender.is_broken = true;
            return self.count(of_owner::NONSENSE, 1);
        }
        let (mut nonsense, mut forged) = (0, 0);
        while *answered != kept {
            let head = read_head(sender.segment.part(self.layout.kept(*answered), HEAD));
            match head.filter(Head::is_command) {
                None => nonsense += 1,
                Some(head) if head.from != sender.from => forged += 1,
                Some(head) => heads.push(head),
            }
            *answered = answered.wrapping_add(1);
        }
        self.own.at(self.layout.lane(lane) + of_lane::ANSWERED).set_release(kept);
        self.count(of_owner::NONSENSE, nonsense);
        self.count(of_owner::FORGED, forged);
    }

    /// Whether a refused command of that lane waits to be answered.
    pub(super) fn keeps_commands(&self, lane: usize) -> bool {
        let Lane { sender, answered, .. } = &self.lanes[lane];
        let sender = sender.as_ref().filter(|sender| !sender.is_broken);
        self.layout.when_full == WhenFull::Answer
            && sender.is_some_and(|sender| sender.segment.at(of_sender::KEPT).get_acquire() != *answered)
    }
}

#[inline]
pub(super) fn write_head(words: &[impl Word], head: &Head) {
    let bytes: [[u8; 8]; HEAD] = zerocopy::transmute!(head.to_bytes());
    for (word, half) in words.iter().zip(bytes) {
        word.set(u64::from_ne_bytes(half));
    }
}

/// `None`: there is no such head.
#[inline]
pub(super) fn read_head(words: &[impl Word]) -> Option<Head> {
    let halves = [words[0].get(), words[1].get()].map(u64::to_ne_bytes);
    let bytes: [u8; HEAD_LEN] = zerocopy::transmute!(halves);
    Head::parse(&bytes).ok()
}
