//! Rings of the token discipline, one situation per file.

mod holder_dies;
mod lost;
