//! What keeps a VNIC's device as it is to be: its name, addresses and MTU, also where slots change and others do.

mod addresses;

use std::io;
use std::time::Instant;

use rtnet::live::Tunnelled;

use addresses::LEAST_MTU_OF_IPV6;

use super::super::{Device, DeviceStatus, Mode, Order, OrderError, StartError, Status};
use super::{LOOK_EVERY, Vnic};
use crate::netlink::{ChangeKind, Heard, Refused};
use crate::tunnel::{LEAST_MTU, Loss};

impl Vnic {
    pub(super) fn obey(&mut self, order: &Order) -> Result<(), OrderError> {
        match order {
            Order::Status => return Ok(()),
            Order::Up if self.device.is_none() => self.make()?,
            Order::Up => self.set_up()?,
            Order::Down | Order::Set(_) if self.device.is_none() => {
                return Err(OrderError::Gone(self.name.clone()));
            }
            Order::Down => self.links.set_up(self.index, false)?,
            Order::Set(change) => self.change(change)?,
        }
        // Who asks is told how fast it is fed now, not how fast it was.
        self.shape();
        Ok(())
    }

    /// Makes the device.
    pub(super) fn make(&mut self) -> Result<(), StartError> {
        let wanted = Some(self.name.as_str()).filter(|name| !name.is_empty());
        let device = Device::open(wanted, self.options.mode)?;
        let name = device.name().to_owned();
        let gone = || io::Error::other(format!("the device '{name}' is gone again"));
        let link = self.links.find(&name)?.ok_or_else(gone)?;
        self.index = link.index;
        if device.mode() == Mode::Tap {
            self.links.set_hardware_address(link.index, self.mouth.config().address.0)?;
        }
        (self.mtu, self.tried) = (0, None);
        self.name = name;
        self.follow_mtu()?;
        self.set_up()?;
        self.device = Some(device);
        self.news = None;
        Ok(())
    }

    fn set_up(&mut self) -> Result<(), Refused> {
        self.links.set_up(self.index, true)?;
        self.give_addresses(&[])
    }

    /// Follows slots that have changed.
    pub(super) fn follow(&mut self) {
        if self.looked.elapsed().as_millis() < LOOK_EVERY.into() {
            return;
        }
        self.looked = Instant::now();
        let dropped = self.socket.as_ref().map_or(0, Tunnelled::take_dropped);
        self.mouth.lose_many(Loss::QueueFull, dropped);
        if self.device.is_none() {
            return;
        }
        if let Err(refused) = self.follow_mtu() {
            self.report(format!("the MTU of '{}' does not follow the slots: {refused}", self.name));
        } else if self.owes_addresses
            && let Err(refused) = self.give_addresses(&[])
        {
            self.report(format!("'{}' lacks an address: {refused}", self.name));
        }
        self.shape();
    }

    /// Until it has succeeded it is tried again.
    fn follow_mtu(&mut self) -> Result<(), Refused> {
        let mtu = self.mouth.mtu().min(self.options.mtu).clamp(LEAST_MTU, self.mouth.most());
        if mtu != self.mtu {
            self.links.set_mtu(self.index, mtu)?;
            self.owes_addresses |= (self.mtu + 1..=mtu).contains(&LEAST_MTU_OF_IPV6);
            self.mtu = mtu;
        }
        Ok(())
    }

    pub(super) fn hear(&mut self, heard: Heard) {
        let Heard::Change(change) = heard else {
            return self.look_at_device();
        };
        if self.device.is_none() || change.index != self.index {
            return;
        }
        match change.kind {
            ChangeKind::Gone => self.look_at_device(),
            ChangeKind::Is { mtu, .. } => {
                // Set by somebody else: what the slots do not take would be lost.
                self.mtu = mtu;
                if change.name != self.name {
                    let line = format!("the VNIC's device '{}' is called '{}' now", self.name, change.name);
                    self.name = change.name;
                    self.report(line);
                }
            }
        }
    }

    fn look_at_device(&mut self) {
        if let (Some(_), Ok(None)) = (&self.device, self.links.get(self.index)) {
            self.lose_device();
        }
    }

    pub(super) fn lose_device(&mut self) {
        self.device = None;
        self.is_full = false;
        let remedy = "`rtnet vnic up` makes it anew";
        self.report(format!("the VNIC's device '{}' was deleted by somebody: {remedy}", self.name));
    }

    pub(super) fn report(&mut self, line: String) {
        if self.news.as_ref() != Some(&line) {
            (self.tell)(&line);
            self.news = Some(line);
        }
    }

    pub(super) fn status(&mut self) -> Result<Status, Refused> {
        let device = match self.device.is_some().then(|| self.links.get(self.index)).transpose()?.flatten() {
            Some(link) => {
                let addresses = self.addresses()?;
                Some(DeviceStatus {
                    is_up: link.is_up,
                    mtu: link.mtu,
                    addresses,
                    queue_full: link.statistics.send_dropped,
                })
            }
            None => None,
        };
        let remarks = self.ipv6_waits().filter(|_| device.is_some()).into_iter().collect();
        let shaping = self.shaping(device.is_some())?;
        Ok(Status {
            name: self.name.clone(),
            mode: self.options.mode,
            is_proxy: self.mouth.is_proxy(),
            device,
            most: self.options.mtu,
            slot: self.mouth.mtu(),
            peers: self.peers.all().to_vec(),
            remarks,
            shaping,
            news: self.news.clone(),
            counts: self.mouth.counts(),
        })
    }
}

#[cfg(test)]
mod tests;
