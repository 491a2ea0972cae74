//! The shortest cycle that a host holds, found by trying: which cycles there are (`ladder`), which to try next (`search`,
//! pure), and what is kept of the answer and compared with later (`answer`, `screen`).

pub mod answer;
pub mod ladder;
pub mod screen;
pub mod search;
