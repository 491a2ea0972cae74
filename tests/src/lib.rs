//! Whole networks, and what tests of them share.
//!
//! ```text
//! bare       a packet socket and nothing else
//! networks   a master and its slaves in virtual time, judged by what is on the air
//! observed   the network of a lab's file in virtual time, judged as a live lab is
//! chance     networks that follow from a seed: schedules, clocks, hosts, faults
//! course     what happens to one of them, and what must be true of it all the while
//! bench      one station by hand: frames in at their stamps, transmissions out at their instants
//! host       real networks: one at a time, and again, aloud, on a host that was disturbed
//! ends       stacks by hand: frames in, calls of programs, and where every buffer is
//! peer       an independent TDMA station with the habits of real RTnet's
//! seeds      with which seeds tests run: drawn from the commit's date
//! rings      rings of the token discipline in virtual time
//! stacks     stations with sockets, and programs that use them
//! tunnels    stations with tunnels, and a simulated Linux at the mouth of each
//! ```

pub mod aloud;
pub mod bare;
pub mod bench;
pub mod captures;
pub mod chance;
pub mod course;
pub mod ends;
pub mod host;
pub mod judge;
pub mod mixed;
pub mod networks;
pub mod observed;
pub mod peer;
pub mod rings;
pub mod seeds;
pub mod stacks;
pub mod traffic;
pub mod tunnels;
pub mod vectors;
