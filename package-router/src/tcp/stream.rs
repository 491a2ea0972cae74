//! A connection of TCP, with TLS or without, that does not wait.

use std::io::{self, IoSlice, Read, Write};
use std::os::fd::AsRawFd;

use mio::net::TcpStream;
use rustls::Connection;
use socket2::SockRef;

/// Bytes of packages that TLS keeps encrypted: a more urgent package overtakes none of them.
const ENCRYPTED: usize = 16 << 10;

/// A connection, in the form in which packages go through it.
pub struct Stream {
    /// The socket.
    pub tcp: TcpStream,
    tls: Option<Box<Connection>>,
    /// Bytes that the socket has taken, encrypted ones if they are.
    taken: u64,
}

impl Stream {
    /// In the clear, or by this session, which has not begun.
    pub fn new(tcp: TcpStream, tls: Option<Connection>) -> Self {
        let mut tls = tls.map(Box::new);
        tls.iter_mut().for_each(|tls| tls.set_buffer_limit(Some(ENCRYPTED)));
        Self { tcp, tls, taken: 0 }
    }

    /// Bytes that the socket has taken.
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// How many of these the peer's kernel has confirmed.
    pub fn arrived(&self) -> u64 {
        // A kernel that does not say has confirmed none.
        unconfirmed(&self.tcp).map_or(0, |bytes| self.taken.saturating_sub(bytes))
    }

    /// Its TLS session, if it has one.
    pub fn tls(&self) -> Option<&Connection> {
        self.tls.as_deref()
    }

    /// Begins its TLS session, as far as that goes without waiting; `true`: it has begun, or there is none.
    pub fn begin(&mut self) -> io::Result<bool> {
        while self.tls.as_ref().is_some_and(|tls| tls.is_handshaking()) {
            if !self.flush_tls()? {
                return Ok(false);
            }
            let Some(tls) = &mut self.tls else { break };
            match tls.read_tls(&mut self.tcp) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(_) => self.process()?,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(false),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        self.flush_tls()?;
        Ok(true)
    }

    /// Whether it reads and writes less at a time than the socket would: with TLS.
    pub fn is_in_parts(&self) -> bool {
        self.tls.is_some()
    }

    /// Hands over what waits to be sent by TLS; `false`: the socket takes no more for now.
    pub fn flush_tls(&mut self) -> io::Result<bool> {
        let Some(tls) = &mut self.tls else { return Ok(true) };
        while tls.wants_write() {
            match tls.write_tls(&mut Quiet(&self.tcp)) {
                Ok(sent) => self.taken += sent as u64,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(false),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }

    fn process(&mut self) -> io::Result<()> {
        let Some(tls) = &mut self.tls else { return Ok(()) };
        if let Err(error) = tls.process_new_packets() {
            // The alert says why, to a peer that still reads.
            self.taken += tls.write_tls(&mut Quiet(&self.tcp)).unwrap_or(0) as u64;
            return Err(io::Error::new(io::ErrorKind::InvalidData, error));
        }
        Ok(())
    }
}

impl Read for Stream {
    /// Bytes of packages. 0: the peer has ended its side. Interrupted: bytes have come that carry none, and more may be there.
    fn read(&mut self, room: &mut [u8]) -> io::Result<usize> {
        for _ in 0..2 {
            let Some(tls) = &mut self.tls else { return self.tcp.read(room) };
            match tls.reader().read(room) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                // A peer that closes without a last alert is gone all the same.
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(0),
                read => return read,
            }
            // The reader knows of 0 bytes by the next time.
            tls.read_tls(&mut self.tcp)?;
            self.process()?;
        }
        Err(io::ErrorKind::Interrupted.into())
    }
}

/// Bytes that a socket has taken, and its peer's kernel has not confirmed.
#[expect(unsafe_code, reason = "no crate here asks a socket for it")]
fn unconfirmed(tcp: &TcpStream) -> io::Result<u64> {
    let mut bytes: libc::c_int = 0;
    // SAFETY: the descriptor is open, and the kernel writes one number.
    let answer = unsafe { libc::ioctl(tcp.as_raw_fd(), libc::TIOCOUTQ, &raw mut bytes) };
    Ok(nix::errno::Errno::result(answer).map(|_| bytes.max(0) as u64)?)
}

/// A socket whose writes end in an error, and in no signal, if the peer has gone: a program in C may not ignore SIGPIPE.
struct Quiet<'a>(&'a TcpStream);

impl Write for Quiet<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        SockRef::from(self.0).send_with_flags(bytes, libc::MSG_NOSIGNAL)
    }

    fn write_vectored(&mut self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        SockRef::from(self.0).send_vectored_with_flags(slices, libc::MSG_NOSIGNAL)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Write for Stream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.write_vectored(&[IoSlice::new(bytes)])
    }

    fn write_vectored(&mut self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        if !self.flush_tls()? {
            return Err(io::ErrorKind::WouldBlock.into());
        }
        match &mut self.tls {
            None => {
                let sent = Quiet(&self.tcp).write_vectored(slices)?;
                self.taken += sent as u64;
                Ok(sent)
            }
            Some(tls) if tls.is_handshaking() => Err(io::ErrorKind::WouldBlock.into()),
            Some(tls) => {
                let taken = tls.writer().write_vectored(slices)?;
                self.flush_tls()?;
                Ok(taken)
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.flush_tls().map(drop)
    }
}
