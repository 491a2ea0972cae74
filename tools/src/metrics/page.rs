//! A page of figures that one thread writes when another one's reader asks for it.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// A page this young is not written again.
const FRESH: Duration = Duration::from_secs(1);
/// How long a reader waits for the writer.
const PATIENCE: Duration = Duration::from_secs(2);

/// The page. The writer looks from time to time whether anybody has asked; it writes once a second at the most, and nothing
/// while nobody reads.
#[derive(Default)]
pub struct Page {
    written: Mutex<Written>,
    answered: Condvar,
}

#[derive(Default)]
struct Written {
    asked: bool,
    page: Option<(Instant, String)>,
}

impl Written {
    fn fresh(&self) -> Option<String> {
        self.page.as_ref().filter(|(at, _)| at.elapsed() < FRESH).map(|(_, text)| text.clone())
    }
}

impl Page {
    /// A page that is younger than a second; none if the writer writes none in time.
    pub fn read(&self) -> Option<String> {
        self.read_within(PATIENCE)
    }

    fn read_within(&self, patience: Duration) -> Option<String> {
        let mut written = self.lock();
        if let Some(text) = written.fresh() {
            return Some(text);
        }
        written.asked = true;
        let waited = self.answered.wait_timeout_while(written, patience, |written| written.asked);
        let (written, _) = waited.unwrap_or_else(PoisonError::into_inner);
        written.fresh()
    }

    /// Writes the page if anybody has asked; a writer that has no figures yet is asked again.
    pub fn write(&self, figures: impl FnOnce() -> Option<String>) {
        if !self.lock().asked {
            return;
        }
        // Figures may take long, and readers of the page before need not wait for them.
        let Some(text) = figures() else { return };
        let mut written = self.lock();
        *written = Written { asked: false, page: Some((Instant::now(), text)) };
        self.answered.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, Written> {
        self.written.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;

    #[test]
    fn page_is_written_only_if_somebody_asks() {
        let page = Page::default();
        page.write(|| panic!("nobody has asked"));
        assert_eq!(page.read_within(Duration::ZERO), None, "nobody writes");
        page.write(|| None);
        page.write(|| Some("x 1\n".into()));
        page.write(|| panic!("it is written"));
        assert_eq!(page.read_within(Duration::ZERO).as_deref(), Some("x 1\n"));
        page.write(|| panic!("it is younger than a second"));
    }

    #[test]
    fn page_that_is_old_is_written_again() {
        let page = Page::default();
        let old = Instant::now().checked_sub(FRESH).unwrap();
        page.lock().page = Some((old, "old".into()));
        assert_eq!(page.read_within(Duration::ZERO), None);
        page.write(|| Some("new".into()));
        assert_eq!(page.read_within(Duration::ZERO).as_deref(), Some("new"));
    }

    #[test]
    fn reader_waits_for_the_writer() {
        let (page, is_over) = (Arc::new(Page::default()), Arc::new(AtomicBool::new(false)));
        let (of_writer, ends) = (page.clone(), is_over.clone());
        let writer = std::thread::spawn(move || {
            while !ends.load(Ordering::Relaxed) {
                of_writer.write(|| Some("x 1\n".into()));
                std::thread::yield_now();
            }
        });
        let read = page.read_within(Duration::from_secs(60));
        is_over.store(true, Ordering::Relaxed);
        writer.join().unwrap();
        assert_eq!(read.as_deref(), Some("x 1\n"));
    }
}
