//! How old a package is, and where its time went.

use package_router::journey::Journey;
use rtnet::time::{GlobalTime, Span};

use crate::components::RtnetComponent;
use crate::guard::guard;
use crate::mailboxes::RtnetMailbox;
use crate::pointers::{exclusive, shared, write};

/// `struct rtnet_journey`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RtnetJourney {
    sent: u64,
    left: u64,
    came: u64,
    delivered: u64,
    received: u64,
    slot_wait_ns: i64,
    wire_ns: i64,
    router_ns: i64,
    mailbox_ns: i64,
    age_ns: i64,
    from_elsewhere: u32,
    reserved: u32,
}

// As the header says.
const _: () = assert!(size_of::<RtnetJourney>() == 88);
/// `RTNET_UNKNOWN_NS`.
const UNKNOWN: i64 = i64::MIN;

impl From<&Journey> for RtnetJourney {
    fn from(journey: &Journey) -> Self {
        let known = |at: Option<GlobalTime>| at.map_or(0, GlobalTime::nanos);
        let took = |span: Option<Span>| span.map_or(UNKNOWN, Span::nanos);
        Self {
            sent: known(journey.sent),
            left: known(journey.left),
            came: known(journey.came),
            delivered: known(journey.delivered),
            received: known(journey.received),
            slot_wait_ns: took(journey.slot_wait()),
            wire_ns: took(journey.wire()),
            router_ns: took(journey.router()),
            mailbox_ns: journey.mailbox.nanos(),
            age_ns: took(journey.age()),
            from_elsewhere: journey.is_from_elsewhere.into(),
            reserved: 0,
        }
    }
}

/// Where the time of the package went that is lent.
///
/// # SAFETY
/// `component` is NULL or a handle, `mailbox` NULL or one that nobody else uses; `journey` is NULL or the place of a journey.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rtnet_mailbox_journey(
    component: *const RtnetComponent,
    mailbox: *mut RtnetMailbox,
    journey: *mut RtnetJourney,
) -> i32 {
    guard("rtnet_mailbox_journey", || {
        // SAFETY: as the caller promises; so it is below.
        let (component, handle) =
            unsafe { (shared("component", component)?, exclusive("mailbox", mailbox)?) };
        let lent = handle.lent()?;
        let told = component.0.times().journey(lent);
        // SAFETY: as above.
        unsafe { write("journey", journey, RtnetJourney::from(&told)) }?;
        Ok(0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_knows_is_told_so_and_all_else_as_it_is() {
        let at = |nanos| Some(GlobalTime::from_nanos(nanos));
        let journey = Journey {
            is_from_elsewhere: true,
            sent: at(100),
            left: at(700),
            came: at(730),
            delivered: at(790),
            received: at(1_000),
            mailbox: Span::from_nanos(210),
        };
        let told = RtnetJourney::from(&journey);
        assert_eq!(
            [told.sent, told.left, told.came, told.delivered, told.received],
            [100, 700, 730, 790, 1_000]
        );
        assert_eq!([told.slot_wait_ns, told.wire_ns, told.router_ns, told.mailbox_ns], [600, 30, 60, 210]);
        assert_eq!((told.age_ns, told.from_elsewhere), (900, 1));
        let told = RtnetJourney::from(&Journey { sent: None, left: None, ..journey });
        assert_eq!((told.sent, told.left), (0, 0));
        assert_eq!(
            [told.slot_wait_ns, told.wire_ns, told.router_ns, told.age_ns],
            [UNKNOWN, UNKNOWN, 60, UNKNOWN]
        );
    }
}
