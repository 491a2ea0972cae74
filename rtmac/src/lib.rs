//! Media access, plugged into [`rtnet`]: when a frame may leave.
//!
//! [`tdma`] is RTnet's time division: a master tells the time once a cycle, every station sends only
//! in its own slots. [`nomac`] is RTmac without slots. [`token`] lets the right to send go round a ring, for segments without good clocks. [`wire`] is what both look like in bytes; [`tdma::schedule`] is the arithmetic of
//! slots that do not overlap.
//!
//! ```
//! use rtmac::tdma::schedule::Rate;
//!
//! // The smallest frame on Fast Ethernet: (60 + 24) bytes of 80 ns.
//! assert_eq!(Rate::from_bits_per_second(100_000_000).air_time(60).nanos(), 6_720);
//! ```

pub mod nomac;
pub mod tdma;
pub mod token;
pub mod wire;
