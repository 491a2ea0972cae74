//! `rtnet dump`.

use std::collections::BTreeMap;
use std::io::{BufWriter, ErrorKind, Write};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use rtnet::live::ring::Captured;

use super::Failure;
use crate::cli::DumpArgs;
use crate::observe::ear::Ear;
use crate::observe::watch::{Sight, Watch};
use crate::report::capture::CaptureFile;
use crate::report::text::grouped;

/// How long syncs are listened to before frames are shown, so that also the first have a slot error.
const LEARN_AT_MOST: Duration = Duration::from_millis(500);
/// Where no cycle was heard in so long, there is nothing to learn.
const HEARD_WITHIN: Duration = Duration::from_millis(500);

/// Shows frames, or writes them, until interrupted, or there are enough.
pub fn dump(args: &DumpArgs) -> Result<u8, Failure> {
    let mut ear = Ear::open(&args.at.spot()).map_err(Failure::Usage)?;
    let mut out = Output::open(args).map_err(Failure::Usage)?;
    eprintln!("rtnet: listening on {}; Ctrl-C ends it", ear.place());
    let mut watch = Watch::default();
    let learned = learn(&mut ear, &mut watch, LEARN_AT_MOST);
    let lost_while_learning = ear.dropped();
    let until = args.duration.map(|span| Instant::now() + Duration::from_nanos(span.nanos() as u64));
    let heard = learned
        .and_then(|goes_on| if goes_on { show(&mut ear, &mut watch, &mut out, until) } else { Ok(()) });
    let written = out.finish(ear.dropped() - lost_while_learning);
    heard.and(written).map(|()| 0).map_err(Failure::Run)
}

/// Listens until it is known where cycles begin, if that is soon. Whether to go on.
pub(super) fn learn(ear: &mut Ear, watch: &mut Watch, at_most: Duration) -> Result<bool> {
    let since = Instant::now();
    let mut goes_on = true;
    while goes_on && !watch.line.is_settled() {
        let enough = if watch.line.period().is_some() { at_most } else { at_most.min(HEARD_WITHIN) };
        if since.elapsed() >= enough {
            break;
        }
        goes_on = ear.listen(|at, frame| {
            let _ = watch.frame(at, frame.bytes, frame.wire_len);
        })?;
    }
    Ok(goes_on)
}

fn show(ear: &mut Ear, watch: &mut Watch, out: &mut Output, until: Option<Instant>) -> Result<()> {
    while !out.is_full() && until.is_none_or(|until| Instant::now() < until) {
        let mut taken = Ok(());
        let goes_on = ear.listen(|at, frame| {
            let sight = watch.frame(at, frame.bytes, frame.wire_len);
            if taken.is_ok() {
                taken = out.take(frame, &sight);
            }
        });
        taken.and_then(|()| out.flush())?;
        if !goes_on? {
            break;
        }
    }
    Ok(())
}

/// Where frames go: into a file, or on the screen.
struct Output {
    file: Option<CaptureFile>,
    screen: BufWriter<std::io::Stdout>,
    /// Whoever reads the screen has had enough.
    closed: bool,
    left: u64,
    frames: u64,
    kinds: BTreeMap<&'static str, u64>,
}

impl Output {
    fn open(args: &DumpArgs) -> Result<Self> {
        let file = args.write.as_deref().map(CaptureFile::create).transpose()?;
        let (screen, left) = (BufWriter::new(std::io::stdout()), args.count.unwrap_or(u64::MAX));
        Ok(Self { file, screen, closed: false, left, frames: 0, kinds: BTreeMap::new() })
    }

    fn is_full(&self) -> bool {
        self.left == 0 || self.closed || self.file.as_ref().is_some_and(CaptureFile::is_closed)
    }

    fn take(&mut self, frame: &Captured<'_>, sight: &Sight) -> Result<()> {
        if self.is_full() {
            return Ok(());
        }
        self.left -= 1;
        self.frames += 1;
        *self.kinds.entry(sight.decoded.what.kind()).or_default() += 1;
        match &mut self.file {
            Some(file) => file.frame(frame.realtime_ns, frame.bytes, Some(&sight.comment())),
            None => {
                let written = writeln!(self.screen, "{}", sight.line(frame.realtime_ns));
                self.note(written)
            }
        }
    }

    fn flush(&mut self) -> Result<()> {
        if let Some(file) = &mut self.file {
            return file.show();
        }
        let flushed = self.screen.flush();
        self.note(flushed)
    }

    fn note(&mut self, written: std::io::Result<()>) -> Result<()> {
        match written {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => {
                self.closed = true;
                Ok(())
            }
            Err(error) => Err(anyhow!("standard output: {error}")),
            Ok(()) => Ok(()),
        }
    }

    /// Completes the file, and tells what there was.
    fn finish(mut self, dropped: u64) -> Result<()> {
        let flushed = self.flush();
        let kinds = self.kinds.iter().map(|(kind, count)| format!("{kind} {}, ", grouped(*count)));
        let kinds: String = kinds.collect();
        eprintln!("rtnet: {} frames: {kinds}lost by the ring {}", grouped(self.frames), grouped(dropped));
        self.file.map_or(Ok(()), CaptureFile::finish).and(flushed)
    }
}
