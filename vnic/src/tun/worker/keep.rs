//! What keeps a VNIC's device as it is to be: its name, addresses and MTU, also where slots change and others do.

mod addresses;

use std::io;
use std::time::Instant;

use rtnet::live::Tunnelled;
use rtnet::wire::ethernet::{self, Address};

use addresses::LEAST_MTU_OF_IPV6;

use super::super::{Device, DeviceStatus, Mode, OpenError, Order, OrderError, StartError, Status};
use super::{LOOK_EVERY, Vnic};
use crate::netlink::{ChangeKind, Heard, Link, Refused};
use crate::tunnel::{LEAST_MTU, Loss};

impl Vnic {
    pub(super) fn obey(&mut self, order: &Order) -> Result<(), OrderError> {
        let obeyed = self.obey_unnamed(order);
        obeyed.map_err(|error| match error {
            OrderError::Link(refused) => self.named(refused).into(),
            OrderError::Start(StartError::Link(refused)) => StartError::from(self.named(refused)).into(),
            other => other,
        })
    }

    /// The kernel's requests are about a number, which nobody else knows the device by.
    fn named(&self, refused: Refused) -> Refused {
        refused.naming(self.index, &self.name)
    }

    fn obey_unnamed(&mut self, order: &Order) -> Result<(), OrderError> {
        match order {
            Order::Status => return Ok(()),
            Order::Up if self.device.is_none() => self.make().map_err(|error| match error {
                StartError::Device(OpenError::Taken(name)) => OpenError::TakenMeanwhile(name).into(),
                other => other,
            })?,
            Order::Up => {
                self.set_up()?;
                self.held_back.try_again();
            }
            Order::Down | Order::Set(_) if self.device.is_none() => {
                return Err(OrderError::Gone(self.name.clone()));
            }
            Order::Down => {
                // Linux empties the filter without a word.
                self.count()?;
                self.links.set_up(self.index, false)?;
            }
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
        self.mtu = 0;
        self.held_back.try_again();
        self.name = name;
        self.follow_mtu()?;
        self.set_up()?;
        self.device = Some(device);
        self.news = None;
        Ok(())
    }

    fn set_up(&mut self) -> Result<(), Refused> {
        if self.has_stations_address() {
            self.links.set_hardware_address(self.index, self.mouth.config().address.0)?;
        }
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
        let small = self.small_slot();
        if let Some(line) = small.as_ref().filter(|_| self.small != small) {
            (self.tell)(line);
        }
        self.small = small;
        if let Err(refused) = self.follow_mtu() {
            self.report_mtu(refused);
        } else if self.owes_addresses
            && let Err(refused) = self.give_addresses(&[])
        {
            let refused = self.named(refused);
            self.report(format!("'{}' lacks an address: {refused}", self.name));
        }
        self.shape();
        // What is lost with a filter or a device is known as of the last look.
        let _ = self.count();
    }

    fn report_mtu(&mut self, refused: Refused) {
        let refused = self.named(refused);
        self.report(format!("the MTU of '{}' does not follow the slots: {refused}", self.name));
    }

    /// What Linux cannot have as small as the slot.
    fn small_slot(&self) -> Option<String> {
        let (takes, head) = (self.mouth.mtu(), ethernet::MTU - self.mouth.most());
        (takes < LEAST_MTU).then(|| {
            format!(
                "the slot takes {takes} bytes of inner payload, a device of Linux at least {LEAST_MTU}: what is longer is lost; \
                 make slot 1, or what stands for it, {} or more",
                LEAST_MTU + head
            )
        })
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

    pub(super) fn hear(&mut self, heard: &Heard) {
        let (is_its, is_without_ipv6) = match heard {
            Heard::Missed => (true, true),
            Heard::Change(change) => match change.kind {
                ChangeKind::Gone => (change.index == self.index, false),
                ChangeKind::Is { is_up, mtu } => {
                    (change.index == self.index, !is_up || mtu < LEAST_MTU_OF_IPV6)
                }
            },
        };
        self.is_changed |= is_its;
        // It may be over once it is looked at, but the addresses are gone.
        self.lost_ipv6 |= is_its && is_without_ipv6;
    }

    /// Looks at the device once something was heard of it: that may be older than what was done to it since.
    pub(super) fn look(&mut self) {
        if self.device.is_none() || !std::mem::take(&mut self.is_changed) {
            return;
        }
        let link = match self.links.get(self.index) {
            Ok(Some(link)) => link,
            Ok(None) => return self.lose_device(),
            // It is asked again.
            Err(_) => return self.is_changed = true,
        };
        if link.name != self.name {
            let line = format!("the VNIC's device '{}' is called '{}' now", self.name, link.name);
            self.name.clone_from(&link.name);
            self.report(line);
        }
        self.set_mtu_back(&link);
        self.set_address_back(&link);
        if link.is_up {
            self.owes_addresses |= std::mem::take(&mut self.lost_ipv6);
        }
    }

    /// What the slots do not take would be lost, and what they take is asked for here.
    fn set_mtu_back(&mut self, link: &Link) {
        self.mtu = link.mtu;
        match self.follow_mtu() {
            Ok(()) if self.mtu == link.mtu => {}
            Ok(()) => self.report(format!(
                "the MTU of '{}' was set to {} by somebody: set back to {}; `rtnet vnic set --mtu` sets it",
                self.name, link.mtu, self.mtu
            )),
            Err(refused) => self.report_mtu(refused),
        }
    }

    /// With another address than its station's Linux takes nothing of what comes for it.
    fn set_address_back(&mut self, link: &Link) {
        let own = self.mouth.config().address;
        if !self.has_stations_address() || link.address == Some(own.0) {
            return;
        }
        let set_back = self.links.set_hardware_address(self.index, own.0);
        let now = link.address.map_or("none".into(), |now| Address(now).to_string());
        let what = match set_back {
            Ok(()) => format!("set back to {own}, its station's"),
            Err(refused) => {
                self.is_changed = true;
                self.named(refused).to_string()
            }
        };
        self.report(format!("the address of '{}' was set to {now} by somebody: {what}", self.name));
    }

    /// With hosts behind it, which are heard by addresses of their own, it may have any.
    fn has_stations_address(&self) -> bool {
        self.options.mode == Mode::Tap && !self.mouth.config().keeps_source
    }

    pub(super) fn lose_device(&mut self) {
        self.device = None;
        // Of none nothing is asked.
        let _ = self.count();
        self.is_full = false;
        let remedy = "`rtnet vnic up` makes it anew";
        self.report(format!(
            "the VNIC's device '{}' was deleted or moved to another namespace by somebody: {remedy}",
            self.name
        ));
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
                    address: link.address.map(Address),
                    addresses,
                })
            }
            None => None,
        };
        let remarks = [self.ipv6_waits(), self.small_slot()].into_iter().flatten();
        let remarks = remarks.filter(|_| device.is_some()).collect();
        self.count()?;
        Ok(Status {
            name: self.name.clone(),
            mode: self.options.mode,
            is_proxy: self.mouth.is_proxy(),
            device,
            most: self.options.mtu,
            slot: self.mouth.mtu(),
            peers: self.peers.all().collect(),
            remarks,
            shaping: self.held_back.shaping(),
            filter: self.held_back.filter(),
            queue_full: self.held_back.queue_full(),
            news: self.news.clone(),
            counts: self.mouth.counts(),
        })
    }
}

#[cfg(test)]
mod tests;
