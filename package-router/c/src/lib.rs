//! Mailboxes for programs in C: `include/rtnet_packages.h` says what each function does.
//!
//! Nothing here trusts what it is given but that a pointer which is not NULL is what the header asks for; and a panic ends here.

#![allow(unsafe_code)]

mod components;
mod failure;
mod guard;
mod heads;
mod journeys;
mod mailboxes;
mod pointers;
mod receiving;
mod routers;
mod senders;

pub use components::{
    RtnetComponent, rtnet_component_attach, rtnet_component_detach, rtnet_component_of_router,
};
pub use guard::rtnet_packages_error;
pub use heads::RtnetHead;
pub use journeys::{RtnetJourney, rtnet_mailbox_journey};
pub use mailboxes::{
    RtnetMailbox, RtnetShape, rtnet_mailbox_clean, rtnet_mailbox_create, rtnet_mailbox_depth,
    rtnet_mailbox_destroy,
};
pub use receiving::{
    rtnet_mailbox_body, rtnet_mailbox_peek, rtnet_mailbox_put_back, rtnet_mailbox_receive,
    rtnet_mailbox_release,
};
pub use routers::{RtnetRouterStatus, rtnet_component_router_status};
pub use senders::{
    RtnetSender, rtnet_sender_bind, rtnet_sender_send, rtnet_sender_send_with, rtnet_sender_set_priority,
    rtnet_sender_unbind,
};

#[cfg(test)]
mod tests;
