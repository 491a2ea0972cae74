//! Of many times, a few.

use serde_json::{Value, json};

/// Room for so many: more are not noted.
const ROOM: usize = 2_000_000;

/// Times, nanoseconds, with room that is there from the start.
pub struct Times {
    noted: Vec<u64>,
    lost: u64,
}

impl Times {
    pub fn new() -> Self {
        let mut noted = vec![1; ROOM];
        noted.clear();
        Self { noted, lost: 0 }
    }

    pub fn note(&mut self, nanos: u64) {
        if self.noted.len() < ROOM {
            self.noted.push(nanos);
        }
    }

    /// What was waited for did not come.
    pub fn note_lost(&mut self) {
        self.lost += 1;
    }

    /// What was noted so far was to warm up.
    pub fn clear(&mut self) {
        self.noted.clear();
        self.lost = 0;
    }

    pub fn figures(&mut self) -> Value {
        self.noted.sort_unstable();
        let of = |share: f64| {
            let rank = (share * self.noted.len() as f64).ceil() as usize;
            self.noted.get(rank.max(1) - 1)
        };
        let [min, p50, p99, p999, max] = [0.0, 0.5, 0.99, 0.999, 1.0].map(of);
        json!({ "n": self.noted.len(), "lost": self.lost, "min": min, "p50": p50, "p99": p99, "p999": p999, "max": max })
    }
}
