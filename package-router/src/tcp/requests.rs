//! Requests to a router that wait for their answers.

use std::collections::VecDeque;

/// Requests that may wait at once: a router has room for as many answers to a client that has not read yet.
pub const OPEN_AT_MOST: usize = 128;

/// The open requests of one connection, in their order: a router answers them in that order.
#[derive(Debug, PartialEq, Eq)]
pub struct Requests<T> {
    open: VecDeque<(u8, T)>,
    id: u8,
}

impl<T> Default for Requests<T> {
    fn default() -> Self {
        Self { open: VecDeque::new(), id: 0 }
    }
}

impl<T> Requests<T> {
    /// Whether another may be opened.
    pub fn has_room(&self) -> bool {
        self.open.len() < OPEN_AT_MOST
    }

    /// Opens one; returns its id.
    pub fn open(&mut self, what: T) -> u8 {
        self.id = self.id.wrapping_add(1);
        self.open.push_back((self.id, what));
        self.id
    }

    /// The request that has this answer; `None`: nothing like it was asked. Earlier ones are not answered any more: they go to `lost`.
    pub fn answered(&mut self, id: u8, mut lost: impl FnMut(T)) -> Option<T> {
        if !self.open.iter().any(|(open, _)| *open == id) {
            return None;
        }
        while let Some((open, what)) = self.open.pop_front() {
            if open == id {
                return Some(what);
            }
            lost(what);
        }
        None
    }

    /// The ids of the open ones.
    #[cfg(test)]
    pub fn ids(&self) -> impl Iterator<Item = u8> {
        self.open.iter().map(|(id, _)| *id)
    }

    /// Whether such a request is open.
    pub fn has(&self, is_such: impl Fn(&T) -> bool) -> bool {
        self.open.iter().any(|(_, open)| is_such(open))
    }

    /// Forgets all: their connection is over.
    pub fn clear(&mut self) {
        self.open.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_ends_its_request_and_those_before() {
        let mut requests = Requests::default();
        let ids: Vec<u8> = (0..3).map(|what| requests.open(what)).collect();
        let mut lost = Vec::new();
        assert_eq!(requests.answered(99, |what| lost.push(what)), None);
        assert_eq!(requests.answered(ids[1], |what| lost.push(what)), Some(1));
        assert_eq!((requests.answered(ids[0], |_| ()), lost), (None, vec![0]));
        assert_eq!(requests.answered(ids[2], |_| ()), Some(2));
    }

    #[test]
    fn ids_are_not_taken_twice_at_a_time() {
        let mut requests = Requests::default();
        for what in 0..1_000u32 {
            if !requests.has_room() {
                let oldest = requests.open[0];
                assert_eq!(requests.answered(oldest.0, |_| panic!("none is lost")), Some(oldest.1));
            }
            let id = requests.open(what);
            assert_eq!(requests.open.iter().filter(|(open, _)| *open == id).count(), 1);
        }
    }
}
