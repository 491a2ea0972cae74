//! A peer's measuring of the delay: the mean of all rounds, of which none is ever repeated.

use rtnet::counters::Refusal;
use rtnet::time::{Instant, Span};

/// The rounds so far.
#[derive(Default)]
pub struct Samples {
    sum: i64,
    taken: u32,
    /// A request is on its way, for ever if need be.
    pub waiting: bool,
}

impl Samples {
    /// A reply; the delay once it was the last.
    pub fn reply(
        &mut self,
        rx: Instant,
        request_xmit: u64,
        reception: u64,
        xmit: u64,
        rounds: u32,
    ) -> Result<Option<Span>, Refusal> {
        if !core::mem::take(&mut self.waiting) {
            return Err(Refusal::UnexpectedReply);
        }
        let round_trip = rx.nanos().wrapping_sub(request_xmit);
        let twice = round_trip.wrapping_sub(xmit.wrapping_sub(reception));
        self.sum += (twice.wrapping_add(1) >> 1) as i64;
        self.taken += 1;
        let mean = Span::from_nanos(self.sum / i64::from(self.taken));
        Ok((self.taken >= rounds).then_some(mean))
    }
}
