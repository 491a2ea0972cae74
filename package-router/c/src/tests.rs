use core::ptr::{null, null_mut};

use super::*;

/// What is NULL is refused by all, and said which it was; what is given back may be NULL.
#[test]
fn null_is_refused_everywhere_and_named() {
    let mut head = RtnetHead::default();
    let mut handle = null_mut();
    // SAFETY: NULL is refused, and all else is what it is said to be.
    let told = unsafe {
        rtnet_component_detach(null_mut());
        rtnet_mailbox_destroy(null_mut());
        rtnet_sender_unbind(null_mut());
        assert_eq!(failure::said(), "", "to give back nothing is nothing");
        let shape = RtnetShape { slots: 1, largest_body: 1, senders: 1, replace: 0 };
        let (body, room) = (null(), null_mut());
        [
            (rtnet_component_attach(null(), &mut null_mut()), "path", failure::said()),
            (rtnet_component_attach(c"x".as_ptr(), null_mut()), "component", failure::said()),
            (rtnet_component_of_router(null(), null(), 0, &mut null_mut()), "router", failure::said()),
            (rtnet_component_router_status(null(), null_mut()), "component", failure::said()),
            (rtnet_mailbox_create(null_mut(), 1, &shape, &mut handle), "component", failure::said()),
            (rtnet_mailbox_create(null_mut(), 1, &shape, null_mut()), "mailbox", failure::said()),
            (rtnet_sender_bind(null_mut(), 1, &mut null_mut()), "from", failure::said()),
            (rtnet_sender_bind(null_mut(), 1, null_mut()), "sender", failure::said()),
            (rtnet_sender_send(null_mut(), 1, body, 0), "sender", failure::said()),
            (rtnet_sender_send_with(null_mut(), &head, body, 0), "sender", failure::said()),
            (rtnet_sender_set_priority(null_mut(), 1), "sender", failure::said()),
            (rtnet_mailbox_receive(null_mut(), &mut head, room, 0, 0), "mailbox", failure::said()),
            (rtnet_mailbox_peek(null_mut(), &mut head, 0), "mailbox", failure::said()),
            (rtnet_mailbox_body(null_mut(), 0, room, 0), "mailbox", failure::said()),
            (rtnet_mailbox_journey(null(), null_mut(), null_mut()), "component", failure::said()),
            (rtnet_mailbox_release(null_mut()), "mailbox", failure::said()),
            (rtnet_mailbox_put_back(null_mut()), "mailbox", failure::said()),
            (rtnet_mailbox_clean(null_mut()), "mailbox", failure::said()),
            (rtnet_mailbox_depth(null_mut()), "mailbox", failure::said()),
        ]
    };
    for (told, what, said) in told {
        assert_eq!(told, -libc::EINVAL, "{said}");
        assert!(said.contains(&format!(": `{what}` points nowhere")), "{what}: {said}");
    }
    assert!(handle.is_null());
}
