//! The report of a run: what was captured, the figures made of it, and how a person reads them.

pub mod capture;
pub mod document;
pub mod draft;
pub mod figures;
pub mod histogram;
pub mod host;
pub mod html;
pub mod intervals;
pub mod junit;
mod others;
pub(crate) mod recorded;
pub mod screen;
pub(crate) mod text;
pub mod verdict;
