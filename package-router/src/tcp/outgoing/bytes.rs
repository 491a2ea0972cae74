//! Bytes in a row: they are appended at the end, and removed at the front or behind what has partly left.

/// Bytes in a row. Removed ones stay in front until they are half of all.
#[derive(Debug, Default)]
pub struct Bytes {
    all: Vec<u8>,
    gone: usize,
}

impl Bytes {
    pub fn as_slice(&self) -> &[u8] {
        &self.all[self.gone..]
    }

    pub fn len(&self) -> usize {
        self.all.len() - self.gone
    }

    pub fn capacity(&self) -> usize {
        self.all.capacity()
    }

    /// Appends a package, or several.
    #[inline]
    pub fn push(&mut self, head: &[u8], body: &[u8]) {
        self.all.reserve(head.len() + body.len());
        self.all.extend_from_slice(head);
        self.all.extend_from_slice(body);
    }

    /// Removes `len` bytes from a place on, and moves the shorter part that is left.
    #[inline]
    pub fn remove(&mut self, from: usize, len: usize) {
        if from > self.len() - from - len {
            self.all.drain(self.gone + from..self.gone + from + len);
            return;
        }
        self.all.copy_within(self.gone..self.gone + from, self.gone + len);
        self.gone += len;
        if 2 * self.gone >= self.all.len() {
            self.close_up();
        }
    }

    /// Frees memory beyond `bytes`, and beyond what is there.
    pub fn shrink_to(&mut self, bytes: usize) {
        self.close_up();
        self.all.shrink_to(bytes);
    }

    fn close_up(&mut self) {
        self.all.copy_within(self.gone.., 0);
        self.all.truncate(self.len());
        self.gone = 0;
    }
}
