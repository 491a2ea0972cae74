//! What `receive` counts: all that comes, for who looks at its end; and data of who asks for it, for `rtnet package bench --stream`.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use nix::sys::signal::{SigSet, Signal};
use package_router::body::{self, record};
use package_router::name::MailboxName;
use package_router::wire::Head;
use serde::Serialize;

use crate::report::document::document;
use crate::report::text::grouped;

/// A command: from now on data of who sends it is counted anew.
pub(super) const COUNT: i8 = 126;
/// A command: how much has come since then. The answer's body is a [`Counted`].
pub(super) const COUNTED: i8 = 127;
/// Senders whose data is counted at a time.
const COUNTED_AT_MOST: usize = 64;

record! {
    /// Data of one sender.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub(super) struct Counted {
        /// How many packages.
        pub packages: u64,
        /// Their bodies together.
        pub bytes: u64,
        /// Nanoseconds from the first one to the last one.
        pub took: u64,
    }
}

/// What a mailbox counts.
pub(super) struct Counts {
    quiet: bool,
    json: bool,
    all: Arc<All>,
    of: BTreeMap<MailboxName, (Counted, Option<Instant>)>,
}

#[derive(Default)]
struct All {
    received: AtomicU64,
    answered: AtomicU64,
}

/// The same as it is shown.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct AllShown {
    /// Packages that came.
    received: u64,
    /// Those of them that were answered.
    answered: u64,
}

document!(AllShown, "package-counts", package_counts_has_its_schema);

impl Counts {
    /// Of a mailbox whose packages are shown, or, if it is `quiet`, only counted: then it tells also when it is ended.
    pub fn of(quiet: bool, json: bool) -> anyhow::Result<Self> {
        let all = Arc::new(All::default());
        if quiet {
            // In this thread and all that it begins: only who waits for them has them.
            let ends = SigSet::from_iter([Signal::SIGINT, Signal::SIGTERM]);
            ends.thread_block()?;
            let all = all.clone();
            std::thread::spawn(move || {
                if ends.wait().is_ok() {
                    std::process::exit(i32::from(all.tell(json).is_err()));
                }
            });
        }
        Ok(Self { quiet, json, all, of: BTreeMap::new() })
    }

    pub fn is_quiet(&self) -> bool {
        self.quiet
    }

    /// A package came.
    pub fn note(&mut self, head: &Head, bytes: usize) {
        self.all.received.fetch_add(1, Ordering::Relaxed);
        if head.is_command() {
            if head.kind == COUNT && (self.of.len() < COUNTED_AT_MOST || self.of.contains_key(&head.from)) {
                self.of.insert(head.from, Default::default());
            }
            return;
        }
        let Some((counted, first)) = self.of.get_mut(&head.from) else { return };
        let now = Instant::now();
        counted.packages += 1;
        counted.bytes += bytes as u64;
        counted.took = now.duration_since(*first.get_or_insert(now)).as_nanos() as u64;
    }

    /// A command was answered, unless that could not be.
    pub fn note_answer(&self, is_sent: bool) {
        self.all.answered.fetch_add(is_sent.into(), Ordering::Relaxed);
    }

    /// The body of the answer to a command that is about what is counted.
    pub fn answer(&self, head: &Head) -> Option<Vec<u8>> {
        let (counted, _) = self.of.get(&head.from).filter(|_| head.kind == COUNTED)?;
        let mut bytes = vec![0; body::len::<Counted>()];
        body::write(counted, head.answer(0).body_order, &mut bytes).ok()?;
        Some(bytes)
    }

    /// At the end.
    pub fn tell(&self) -> anyhow::Result<()> {
        if self.quiet { self.all.tell(self.json) } else { Ok(()) }
    }
}

impl All {
    fn tell(&self, json: bool) -> anyhow::Result<()> {
        let [received, answered] =
            [&self.received, &self.answered].map(|count| count.load(Ordering::Relaxed));
        crate::cmd::print(json, &AllShown { received, answered }, |all| {
            format!("{} received, {} answered\n", grouped(all.received), grouped(all.answered))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use package_router::wire::Endian;

    #[test]
    fn data_is_counted_of_who_asked_for_it_from_then_on_and_told_as_often_as_that_is_asked() {
        let (bench, other, to) =
            (MailboxName(0x00ff_0200), MailboxName(0x00ff_0300), MailboxName(0x0010_0000));
        let mut counts = Counts::of(false, false).unwrap();
        let told = |counts: &Counts, from| {
            let body = counts.answer(&Head::new(COUNTED, to, from))?;
            body::read::<Counted>(&body, Endian::Little).ok()
        };
        let data = |from| Head::new(-6, to, from);
        counts.note(&data(bench), 10);
        assert_eq!(told(&counts, bench), None, "nobody had asked for that");
        for _ in 0..2 {
            counts.note(&Head::new(COUNT, to, bench), 0);
            assert_eq!(told(&counts, bench), Some(Counted::default()));
            for (n, from) in [bench, other, bench, bench].into_iter().enumerate() {
                counts.note(&data(from), n);
            }
            counts.note(&Head::new(5, to, bench), 1_000);
            for _ in 0..2 {
                let Counted { packages, bytes, .. } = told(&counts, bench).unwrap();
                assert_eq!((packages, bytes), (3, 5));
            }
            assert_eq!(told(&counts, other), None);
        }
        assert_eq!(
            counts.answer(&Head::new(5, to, bench)),
            None,
            "any other command is answered by its body"
        );
        assert_eq!(counts.all.received.load(Ordering::Relaxed), 13);
    }

    #[test]
    fn whoever_asks_takes_no_more_than_there_is_room_for() {
        let mut counts = Counts::of(false, false).unwrap();
        for from in 0..1_000 {
            counts.note(&Head::new(COUNT, MailboxName(0x0010_0000), MailboxName(from)), 0);
        }
        assert_eq!(counts.of.len(), COUNTED_AT_MOST);
    }
}
