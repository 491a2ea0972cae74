//! The addresses of a VNIC's device: it has a list of its own, and is given again what the kernel takes away with others.

use super::super::super::{Change, Mode, OrderError, StartError};
use super::super::Vnic;
use crate::netlink::Refused;
use crate::peers::Prefix;

/// Below it Linux has no IPv6 on a device.
pub(super) const LEAST_MTU_OF_IPV6: usize = 1280;

impl Vnic {
    /// All of it or, where something is refused, nothing.
    pub(super) fn change(&mut self, change: &Change) -> Result<(), OrderError> {
        let Change { add, remove, peers, .. } = change;
        if self.mouth.is_proxy() && !(add.is_empty() && remove.is_empty() && peers.is_empty()) {
            return Err(StartError::OfStation.into());
        }
        if self.options.mode == Mode::Tap && !peers.is_empty() {
            return Err(OrderError::NoPeers);
        }
        if let Some(mtu) = change.mtu.filter(|&mtu| mtu > self.mouth.most()) {
            return Err(OrderError::Mtu(mtu, self.mouth.most()));
        }
        add.iter().try_for_each(|added| self.check(added, remove))?;
        let mut table = self.peers.clone();
        peers.iter().try_for_each(|&peer| table.add(peer))?;

        let (mut before, mtu) = (self.addresses()?, self.options.mtu);
        let is_known = |own: &&Prefix| before.contains(own) || self.options.addresses.contains(own);
        if let Some(&unknown) = remove.iter().find(|gone| !is_known(gone)) {
            return Err(OrderError::NoSuchAddress(unknown));
        }
        let changed = self.change_device(change);
        if changed.is_ok() {
            before.retain(|had| !remove.contains(had));
            let own = &mut self.options.addresses;
            for added in add {
                if !own.contains(added) {
                    own.push(*added);
                }
            }
            own.retain(|own| !remove.contains(own));
            self.peers = table.with_own(own.clone());
        } else {
            // What has just been done can be undone, but for what somebody else has done meanwhile.
            for added in add.iter().filter(|added| !before.contains(added)) {
                let _ = self.links.remove_address(self.index, added.ip, added.length);
            }
            self.options.mtu = mtu;
            let _ = self.follow_mtu();
        }
        // With the first address of a network the kernel takes its others. What cannot be given now is tried again.
        self.owes_addresses = true;
        let _ = self.give_addresses(&before);
        Ok(changed?)
    }

    /// Whether an address may be added where these are taken away.
    fn check(&self, added: &Prefix, removed: &[Prefix]) -> Result<(), OrderError> {
        added.of_a_host()?;
        let is_other = |own: &&Prefix| own.ip == added.ip && own.length != added.length && own.ip.is_ipv6();
        let other = self.options.addresses.iter().find(|own| is_other(own) && !removed.contains(own));
        other.map_or(Ok(()), |&other| Err(OrderError::OtherPrefix(other, *added)))
    }

    fn change_device(&mut self, change: &Change) -> Result<(), Refused> {
        self.options.mtu = change.mtu.unwrap_or(self.options.mtu);
        self.follow_mtu()?;
        // Another prefix of the same address would be in the way; the last one of all takes routes along.
        let is_first = |gone: &&Prefix| change.add.iter().any(|new| new.ip == gone.ip && new != *gone);
        let (first, then): (Vec<_>, Vec<_>) = change.remove.iter().partition(is_first);
        for removed in first {
            self.take_address(removed)?;
        }
        for added in change.add.iter().filter(|added| has_room(self.mtu, added)) {
            self.links.add_address(self.index, added.ip, added.length)?;
        }
        then.into_iter().try_for_each(|removed| self.take_address(removed))
    }

    /// It may be gone already: with another of its network.
    fn take_address(&mut self, removed: &Prefix) -> Result<(), Refused> {
        if !self.addresses()?.contains(removed) {
            return Ok(());
        }
        self.links.remove_address(self.index, removed.ip, removed.length)
    }

    /// Gives it those of its own, and others that it had, as far as they are missing. Those of IPv6 Linux takes away while
    /// it is down, or its MTU is too small for them.
    pub(super) fn give_addresses(&mut self, others: &[Prefix]) -> Result<(), Refused> {
        // A host may have switched it off for all devices, so that they are silent: in the tunnel nobody minds, and no real-time
        // route leads there. A kernel without IPv6 has no such switch.
        let is_off = if self.mouth.is_proxy() { "1" } else { "0" };
        let _ = std::fs::write(format!("/proc/sys/net/ipv6/conf/{}/disable_ipv6", self.name), is_off);
        let there = self.addresses()?;
        for missing in self.options.addresses.iter().chain(others) {
            if has_room(self.mtu, missing) && !there.contains(missing) {
                self.links.add_address(self.index, missing.ip, missing.length)?;
            }
        }
        self.owes_addresses = false;
        Ok(())
    }

    /// What the device has now.
    pub(super) fn addresses(&mut self) -> Result<Vec<Prefix>, Refused> {
        let all = self.links.addresses(self.index)?;
        Ok(all.into_iter().map(|(ip, length)| Prefix { ip, length }).collect())
    }

    /// What it will have once its MTU is large enough.
    pub(super) fn ipv6_waits(&self) -> Option<String> {
        let waiting = self.options.addresses.iter().filter(|own| !has_room(self.mtu, own));
        let waiting: Vec<_> = waiting.map(Prefix::to_string).collect();
        let why = format!("it needs an MTU of {LEAST_MTU_OF_IPV6}");
        (!waiting.is_empty()).then(|| format!("IPv6 waits: {why} ({})", waiting.join(", ")))
    }
}

fn has_room(mtu: usize, address: &Prefix) -> bool {
    address.ip.is_ipv4() || mtu >= LEAST_MTU_OF_IPV6
}
