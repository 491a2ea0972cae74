//! An end that is a mailbox, and a way to the other's.

use std::path::Path;

use anyhow::Result;
use package_router::component::{Mailbox, Sender};
use package_router::mailbox::Shape;

use crate::exchange::{End, MESSAGE, Message, Way};
use crate::station::{bound, mailbox, name};

/// Of who asks and who answers.
const CLASSES: [u8; 2] = [0x80, 0x81];
const SHAPE: Shape = Shape::new(16, MESSAGE);

pub struct MailboxEnd {
    mailbox: Mailbox,
    sender: Sender,
    way: Way,
}

impl MailboxEnd {
    /// `told` is called once the other may come.
    pub fn open(place: &Path, way: Way, number: usize, told: impl FnOnce()) -> Result<Self> {
        let mailbox = mailbox(place, name(CLASSES[number]), SHAPE)?;
        told();
        let sender = bound(&mailbox, name(CLASSES[1 - number]))?;
        Ok(Self { mailbox, sender, way })
    }
}

impl End for MailboxEnd {
    fn say(&mut self, message: &Message) -> Result<()> {
        self.sender.send(1, message)?;
        Ok(())
    }

    fn hear(&mut self, room: &mut Message) -> Result<()> {
        if self.way == Way::Block {
            self.mailbox.receive(None)?.body().copy_to(0, room);
            return Ok(());
        }
        loop {
            if let Some(package) = self.mailbox.try_receive()? {
                package.body().copy_to(0, room);
                return Ok(());
            }
            core::hint::spin_loop();
        }
    }
}
