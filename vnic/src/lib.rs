//! Everything that is not real-time goes through the tunnel: a network device whose frames leave inside RTmac frames, in
//! turns that nothing real-time wants.
//!
//! [`tunnel`] is pure, and the same in virtual time, and so is [`proxy`], which gives Linux the station's own address instead
//! of another; [`tun`] is the device that Linux sees, and the thread behind it; [`netlink`] is what the kernel is asked about
//! it; where only packets go through, [`peers`] says who has which address, and [`resolve`] asks and answers by ARP.
//!
//! ```
//! use rtnet::wire::ethernet::{Address, EtherType};
//! use vnic::tunnel::{self, Config};
//!
//! let address = Address([2, 0, 0, 0, 0, 3]);
//! let (_for_the_station, mouth) = tunnel::new(Config::of(address));
//! // Sixteen bytes of a packet that Linux sends to everybody.
//! let mut room = mouth.take().expect("32 of them");
//! room.room_mut()[tunnel::HEAD..][..16].fill(0x45);
//! mouth.send_packet(room, 16, Address::BROADCAST, EtherType::IPV4).expect("it is short enough");
//! ```

pub mod netlink;
pub mod peers;
pub mod proxy;
pub mod resolve;
pub mod tun;
pub mod tunnel;
