//! Rings of the token discipline, one situation per file.

mod access_delay;
mod by_chance;
mod comes_back;
mod doubled;
mod files;
mod held_up;
mod holder_dies;
mod lost;
mod parted;
mod rests;
