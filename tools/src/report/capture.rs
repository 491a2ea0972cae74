//! Captures for Wireshark: pcapng, to the nanosecond.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result};
use pcap_file::pcapng::PcapNgWriter;
use pcap_file::pcapng::blocks::enhanced_packet::{EnhancedPacketBlock, EnhancedPacketOption};
use pcap_file::pcapng::blocks::interface_description::{
    InterfaceDescriptionBlock, InterfaceDescriptionOption, InterfaceTsResolution,
};
use pcap_file::pcapng::blocks::opt_common::CommonOption;
use pcap_file::pcapng::blocks::section_header::{SectionHeaderBlock, SectionHeaderOption};
use pcap_file::{DataLink, Endianness};

use super::draft::{Draft, is_standard_output};
use crate::remedy::explained;

const APPLICATION: &str = concat!("rtnet ", env!("CARGO_PKG_VERSION"));

/// The only interface in a file.
const MEDIUM: &str = "medium";

/// The length of an option is a `u16`.
const MAX_COMMENT: usize = u16::MAX as usize;

/// A file of frames from one medium. Dropped without [`CaptureFile::finish`], it may lack its end.
#[derive(Debug)]
pub struct CaptureFile {
    path: PathBuf,
    writer: Writer,
    /// It is to take the place of what may be there.
    draft: Option<Draft>,
    /// Somebody may read it while it is written.
    is_read: bool,
    /// Whoever read it has had enough.
    is_closed: bool,
}

impl CaptureFile {
    /// Makes the file, or empties it, and writes its head: the section, and one Ethernet interface
    /// whose stamps count nanoseconds. `-` is standard output.
    ///
    /// # Errors
    /// The file cannot be made or written. Names it.
    pub fn create(path: &Path) -> Result<Self> {
        match is_standard_output(path) {
            true => Self::standard_output(),
            false => {
                let file = File::create(path).map_err(explained);
                let file = file.with_context(|| format!("cannot create {}", path.display()))?;
                Self::begin(path, file, None)
            }
        }
    }

    /// The same, but what is there stays until this is whole; if it never is, nothing of it remains.
    ///
    /// # Errors
    /// The file could not be made or written. Names it.
    pub fn replace(path: &Path) -> Result<Self> {
        if is_standard_output(path) {
            return Self::standard_output();
        }
        let begun = Draft::begin(path).map_err(explained);
        let (draft, file) = begun.with_context(|| format!("cannot create {}", path.display()))?;
        Self::begin(path, file, Some(draft))
    }

    fn standard_output() -> Result<Self> {
        let file = io::stdout().as_fd().try_clone_to_owned().context("cannot write to standard output")?;
        Self::begin(Path::new("standard output"), File::from(file), None)
    }

    fn begin(path: &Path, file: File, draft: Option<Draft>) -> Result<Self> {
        let is_read = file.metadata().is_ok_and(|there| !there.is_file());
        let writer = Writer::new(file).with_context(|| cannot_write(path))?;
        Ok(Self { path: path.to_owned(), writer, draft, is_read, is_closed: false })
    }

    /// Adds a frame, from its destination address on and without the checksum. `realtime_ns` is
    /// CLOCK_REALTIME in nanoseconds. A comment is cut off after 65 535 bytes, the most that the
    /// format holds.
    ///
    /// # Errors
    /// The file cannot be written; it ends in the middle of a frame then. Names it.
    pub fn frame(&mut self, realtime_ns: u64, bytes: &[u8], comment: Option<&str>) -> Result<()> {
        if self.is_closed {
            return Ok(());
        }
        let written = self.writer.frame(realtime_ns, bytes, comment);
        self.unless_closed(written)
    }

    /// Shows what there is so far to whoever reads it meanwhile: from standard output, or a pipe.
    ///
    /// # Errors
    /// See [`CaptureFile::frame`].
    pub fn show(&mut self) -> Result<()> {
        if !self.is_read || self.is_closed {
            return Ok(());
        }
        let written = self.writer.0.get_mut().flush().map_err(Into::into);
        self.unless_closed(written)
    }

    /// Whether whoever read it has had enough, which is no error.
    pub fn is_closed(&self) -> bool {
        self.is_closed
    }

    fn unless_closed(&mut self, written: Result<()>) -> Result<()> {
        let is_of_pipe = |error: &anyhow::Error| {
            error
                .chain()
                .filter_map(|cause| cause.downcast_ref::<io::Error>())
                .any(|cause| cause.kind() == ErrorKind::BrokenPipe)
        };
        match written {
            Err(error) if is_of_pipe(&error) => {
                self.is_closed = true;
                Ok(())
            }
            other => other.with_context(|| cannot_write(&self.path)),
        }
    }

    /// Writes what is still buffered, and is there.
    ///
    /// # Errors
    /// The file cannot be written. Names it.
    pub fn finish(mut self) -> Result<()> {
        if !self.is_closed {
            let written = self.writer.0.get_mut().flush().map_err(Into::into);
            self.unless_closed(written)?;
        }
        self.draft.map_or(Ok(()), Draft::keep).with_context(|| cannot_write(&self.path))
    }

    /// It cannot be written any more, and what there is of it is better than nothing.
    pub fn give_up(self) {
        let _ = self.draft.map(Draft::keep);
    }
}

/// A capture beside a run, which goes on without it. Why it is not whole is told at the end.
#[derive(Debug, Default)]
pub struct Capture {
    file: Option<CaptureFile>,
    failed: Option<String>,
}

impl Capture {
    /// Into this file, if there is to be one.
    pub fn of(file: Option<CaptureFile>) -> Self {
        Self { file, failed: None }
    }

    /// Whether frames are still written.
    pub fn goes_on(&self) -> bool {
        self.file.is_some()
    }

    /// See [`CaptureFile::frame`].
    pub fn frame(&mut self, realtime_ns: u64, bytes: &[u8], comment: Option<&str>) {
        if let Some(file) = &mut self.file {
            let written = file.frame(realtime_ns, bytes, comment);
            self.end_if(written);
        }
    }

    /// See [`CaptureFile::show`].
    pub fn show(&mut self) {
        if let Some(file) = &mut self.file {
            let written = file.show();
            self.end_if(written);
        }
    }

    /// See [`CaptureFile::finish`].
    pub fn finish(&mut self) {
        let finished = self.file.take().map_or(Ok(()), CaptureFile::finish);
        self.end_if(finished);
    }

    /// Why it is not whole: the file, and the error.
    pub fn failed(&self) -> Option<&str> {
        self.failed.as_deref()
    }

    /// What cannot be written ends there. What there is of it stays.
    fn end_if(&mut self, written: Result<()>) {
        if let Err(error) = written {
            self.file.take().into_iter().for_each(CaptureFile::give_up);
            self.failed = Some(format!("{error:#}"));
        }
    }
}

fn cannot_write(path: &Path) -> String {
    format!("cannot write the capture {}", path.display())
}

/// The format, apart from the file's name.
struct Writer(PcapNgWriter<BufWriter<File>>);

impl std::fmt::Debug for Writer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Writer").field(self.0.get_ref()).finish()
    }
}

impl Writer {
    fn new(file: File) -> Result<Self> {
        // The library's default is big-endian; little-endian on every host keeps captures comparable.
        let section = SectionHeaderBlock {
            endianness: Endianness::Little,
            options: vec![SectionHeaderOption::UserApplication(APPLICATION.into())],
            ..SectionHeaderBlock::default()
        };
        let mut writer = PcapNgWriter::with_section_header(BufWriter::new(file), section)?;
        // Without the resolution the library would round every stamp down to a microsecond, and say
        // nothing. A snap length of 0 is "no limit".
        let mut interface = InterfaceDescriptionBlock::new(DataLink::ETHERNET, 0);
        interface.options = vec![
            InterfaceDescriptionOption::IfName(MEDIUM.into()),
            InterfaceDescriptionOption::IfTsResol(InterfaceTsResolution::NANO),
        ];
        writer.write_pcapng_block(interface)?;
        Ok(Self(writer))
    }

    fn frame(&mut self, realtime_ns: u64, bytes: &[u8], comment: Option<&str>) -> Result<()> {
        let comment = comment.map(|text| &text[..text.floor_char_boundary(MAX_COMMENT)]);
        self.0.write_pcapng_block(EnhancedPacketBlock {
            interface_id: 0,
            timestamp: Duration::from_nanos(realtime_ns),
            original_len: u32::try_from(bytes.len()).context("longer than any frame")?,
            data: Cow::Borrowed(bytes),
            options: comment
                .map(|text| EnhancedPacketOption::Common(CommonOption::Comment(text.into())))
                .into_iter()
                .collect(),
        })?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pcap_file::pcapng::{Block, PcapNgReader};

    /// Stamps that a microsecond, a `f64` or 63 bits do not hold.
    const STAMPS: [u64; 5] =
        [0, 1, 1_700_000_000_123_456_789, 1_700_000_000_999_999_999, 18_446_744_073_709_551_615];

    fn written(frames: &[(u64, &[u8], Option<&str>)]) -> (tempfile::TempDir, PathBuf) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.pcapng");
        let mut file = CaptureFile::create(&path).unwrap();
        for &(at, bytes, comment) in frames {
            file.frame(at, bytes, comment).unwrap();
        }
        file.finish().unwrap();
        (directory, path)
    }

    fn read(path: &Path) -> Vec<(u64, Vec<u8>, Option<String>)> {
        let mut reader = PcapNgReader::new(File::open(path).unwrap()).unwrap();
        let mut frames = Vec::new();
        while let Some(block) = reader.next_block() {
            let (Block::EnhancedPacket(packet), _) = block.unwrap() else { continue };
            let comment = packet.options.iter().find_map(|option| match option {
                EnhancedPacketOption::Common(CommonOption::Comment(text)) => Some(text.to_string()),
                _ => None,
            });
            let at = u64::try_from(packet.timestamp.as_nanos()).unwrap();
            assert_eq!(packet.original_len as usize, packet.data.len());
            frames.push((at, packet.data.into_owned(), comment));
        }
        frames
    }

    #[test]
    fn nanoseconds_come_back_exactly() {
        let frames = STAMPS.map(|at| (at, &[0xa5; 60][..], None));
        let (_directory, path) = written(&frames);
        assert_eq!(read(&path).into_iter().map(|(at, ..)| at).collect::<Vec<_>>(), STAMPS);
    }

    #[test]
    fn comments_of_any_length_come_back() {
        // One byte too long for the format, and the cut falls into a character.
        let long = "a".repeat(MAX_COMMENT - 1) + "µ";
        let (_directory, path) =
            written(&[(1, &[7; 61], Some("slot 3: overrun")), (2, &[8; 62], Some(&long))]);
        let frames = read(&path);
        assert_eq!(frames[0], (1, vec![7; 61], Some("slot 3: overrun".to_owned())));
        assert_eq!(frames[1], (2, vec![8; 62], Some("a".repeat(MAX_COMMENT - 1))));
    }

    #[test]
    fn the_bytes_are_what_the_format_says() {
        let at = STAMPS[2];
        let (_directory, path) = written(&[(at, &[0xa5; 60], None)]);
        let bytes = std::fs::read(path).unwrap();
        let word = |offset: usize| u32::from_le_bytes(*bytes[offset..].first_chunk().unwrap());

        assert_eq!((word(0), word(8)), (0x0a0d_0d0a, 0x1a2b_3c4d)); // section, byte order
        let interface = word(4) as usize;
        assert_eq!((word(interface), word(interface + 8)), (1, 1)); // interface, Ethernet
        let options = &bytes[interface + 16..][..word(interface + 4) as usize - 20];
        let expected = [
            &[2, 0, 6, 0][..], // if_name
            b"medium\0\0",
            &[9, 0, 1, 0, 9, 0, 0, 0], // if_tsresol: 10^-9 s
            &[0, 0, 0, 0],             // opt_endofopt
        ]
        .concat();
        assert_eq!(options, expected);
        let packet = interface + word(interface + 4) as usize;
        assert_eq!((word(packet), word(packet + 8)), (6, 0)); // enhanced packet on interface 0
        assert_eq!(u64::from(word(packet + 12)) << 32 | u64::from(word(packet + 16)), at);
        assert_eq!((word(packet + 20), word(packet + 24)), (60, 60)); // captured, original
        assert_eq!(bytes.len(), packet + word(packet + 4) as usize);
    }

    #[test]
    fn errors_name_the_file() {
        let refused = CaptureFile::create(Path::new("/nowhere/a.pcapng")).unwrap_err();
        assert!(format!("{refused:#}").contains("/nowhere/a.pcapng"), "{refused:#}");

        // Nothing fits on this device: what is still buffered fails only in the end.
        let full = Path::new("/dev/full");
        let mut file = CaptureFile::create(full).unwrap();
        file.frame(1, &[0; 60], None).unwrap();
        let refused = file.finish().unwrap_err();
        assert!(format!("{refused:#}").contains("/dev/full: "), "{refused:#}");
    }
}
