//! Joint slots: several slots of a station that take frames from one queue, which so has several opportunities in a
//! cycle. Of what is configured only: who plans slots goes by the same rules as the station that has them.
//!
//! ```text
//! slot   0 ──────── 2->0 ─────── 3->2     offset, phase and period are each one's own, the size is the same
//!        └────────────┴────────────┘
//!                queue of 0               whoever joins slot 2 joins what that is joined to: 3->0
//! ```

use rtnet::discipline::Channel;

use super::config::Refused;
use super::slot::{NON_RT_SLOT, RT_SLOT, SlotConfig};

/// The slot whose queue `slot` is to take from if that is not its own. `get` knows the others: any of them may be joined
/// to, also the one with the highest id, which RTnet refuses.
pub fn owner(
    slot: &SlotConfig,
    get: impl Fn(Channel) -> Option<SlotConfig>,
) -> Result<Option<Channel>, Refused> {
    let SlotConfig { id, size, joint, .. } = *slot;
    let Some(joint) = joint else { return Ok(None) };
    let mut target = joint;
    // A chain that is longer than there are ids goes round.
    for _ in 0..=Channel::MAX {
        if target == id {
            break;
        }
        let other = get(target).ok_or(Refused::JointUndefined { id, joint: target })?;
        if other.size != size {
            return Err(Refused::JointSize { id, size, joint: target, other: other.size });
        }
        match other.joint {
            None => return Ok(Some(target)),
            Some(further) => target = further,
        }
    }
    Err(Refused::JointRound { id, joint })
}

/// The slots of a station that take what is given to a channel: those of its queue. What is not real-time goes by slot 0 where there is no
/// slot 1. `of` tells a slot's id, and whose queue it takes from if not its own. None: the station has no slot for it.
pub fn serving<T>(slots: &[T], of: impl Fn(&T) -> (Channel, Option<Channel>), channel: Channel) -> Vec<&T> {
    let queue = |slot: &T| {
        let (id, joint) = of(slot);
        joint.unwrap_or(id)
    };
    let named = |id: Channel| slots.iter().find(|slot| of(slot).0 == id);
    let alias = || (channel == NON_RT_SLOT).then(|| named(RT_SLOT)).flatten();
    let Some(shared) = named(channel).or_else(alias).map(queue) else { return Vec::new() };
    slots.iter().filter(|slot| queue(slot) == shared).collect()
}

/// What becomes of `slot` when `target` is redefined so, if anything does. One that is joined to it goes along as long
/// as it need not grow: what comes behind it has been planned for its size. Else it has a queue of its own.
pub fn follow(slot: &SlotConfig, target: &SlotConfig) -> Option<SlotConfig> {
    if slot.joint != Some(target.id) {
        return None;
    }
    let followed = if target.size <= slot.size {
        SlotConfig { size: target.size, joint: Some(target.queue()), ..*slot }
    } else {
        SlotConfig { joint: None, ..*slot }
    };
    (followed != *slot).then_some(followed)
}

/// A station's slots, in any order, each joined to the one whose queue it takes from.
pub fn resolved(slots: &[SlotConfig]) -> Result<Vec<SlotConfig>, Refused> {
    let get = |id| slots.iter().find(|slot| slot.id == id).copied();
    slots.iter().map(|slot| Ok(SlotConfig { joint: owner(slot, get)?, ..*slot })).collect()
}

/// The same once `slot` is defined or changed: those that are joined to it follow.
pub fn redefined(slots: &[SlotConfig], slot: SlotConfig) -> Result<Vec<SlotConfig>, Refused> {
    let get = |id| slots.iter().find(|slot| slot.id == id).copied();
    let slot = SlotConfig { joint: owner(&slot, get)?, ..slot };
    let others = slots.iter().filter(|other| other.id != slot.id);
    Ok(others.map(|other| follow(other, &slot).unwrap_or(*other)).chain([slot]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::time::Span;

    fn slot(id: Channel, size: usize, joint: Option<Channel>) -> SlotConfig {
        SlotConfig { id, offset: Span::ZERO, phase: 0, period: 1, size, joint, latest: Span::ZERO }
    }

    fn joints(slots: &[SlotConfig]) -> Result<Vec<Option<Channel>>, Refused> {
        resolved(slots).map(|slots| slots.iter().map(|slot| slot.joint).collect())
    }

    #[test]
    fn chains_end_at_one_queue_in_whatever_order_they_are_written() {
        let chain = [slot(7, 100, Some(2)), slot(2, 100, Some(0)), slot(0, 100, None), slot(3, 60, None)];
        assert_eq!(joints(&chain), Ok(vec![Some(0), Some(0), None, None]));
    }

    #[test]
    fn what_cannot_be_joined_is_refused_by_both_names() {
        let own = slot(0, 100, None);
        let undefined = Refused::JointUndefined { id: 2, joint: 1 };
        assert_eq!(
            joints(&[own, slot(2, 100, Some(1))]),
            Err(undefined),
            "another name of slot 0 is no slot"
        );
        let unequal = Refused::JointSize { id: 2, size: 99, joint: 0, other: 100 };
        assert_eq!(joints(&[own, slot(2, 99, Some(0))]), Err(unequal));
        let itself = Refused::JointRound { id: 2, joint: 2 };
        assert_eq!(joints(&[slot(2, 100, Some(2))]), Err(itself));
        let round = [slot(4, 100, Some(2)), slot(2, 100, Some(3)), slot(3, 100, Some(2))];
        assert_eq!(
            joints(&round),
            Err(Refused::JointRound { id: 4, joint: 2 }),
            "it is not on the round itself"
        );
        for refused in [undefined, unequal, itself] {
            let why = refused.to_string();
            assert!(why.contains("slot 2") && why.contains(':'), "{why}");
        }
    }

    #[test]
    fn joint_slots_follow_one_that_does_not_grow_and_no_other() {
        let joined = slot(2, 100, Some(0));
        assert_eq!(follow(&joined, &slot(0, 60, None)), Some(slot(2, 60, Some(0))));
        assert_eq!(follow(&joined, &slot(0, 101, None)), Some(slot(2, 100, None)));
        assert_eq!(follow(&joined, &slot(0, 100, Some(3))), Some(slot(2, 100, Some(3))));
        assert_eq!(follow(&joined, &slot(0, 100, None)), None, "as it was");
        assert_eq!(follow(&joined, &slot(3, 60, None)), None, "not joined to that");
        let all = redefined(&[slot(0, 100, None), joined, slot(3, 60, None)], slot(0, 60, Some(3)));
        assert_eq!(all, Ok(vec![slot(2, 60, Some(3)), slot(3, 60, None), slot(0, 60, Some(3))]));
    }
}
