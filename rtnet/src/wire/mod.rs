//! Frame layouts. A header is parsed once, checked, and then read without further checks.

pub mod ethernet;
