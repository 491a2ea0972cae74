//! Figures for Prometheus, by HTTP: a thread that answers one request at a time.

mod page;

use std::fmt::{Display, Write as _};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::thread::Builder;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};

pub use self::page::Page;
use crate::remedy::explained;

/// Time since the start: name and meaning. Stations and routers have this figure and the next ones in common.
pub const UP: [&str; 2] = ["rtnet_up_seconds", "Time since the start."];
/// Open connections by TCP.
pub const CONNECTIONS: [&str; 2] = ["rtnet_connections", "Open connections by TCP."];
/// Mailboxes that are registered at a TCP router.
pub const MAILBOXES: [&str; 2] = ["rtnet_mailboxes", "Mailboxes that are registered at a TCP router."];
/// Packages that wait to be sent by TCP.
pub const WAITING: [&str; 2] = ["rtnet_waiting_packages", "Packages that wait to be sent by TCP."];
/// All that is counted.
pub const EVENTS: [&str; 2] = ["rtnet_events_total", "All that is counted, by group and reason."];
/// Longest head of a request, and how long a client may take for it.
const HEAD_AT_MOST: usize = 4 << 10;
const PATIENCE: Duration = Duration::from_secs(2);
/// After an accept that failed for want of descriptors the next is tried so much later.
const REST: Duration = Duration::from_millis(100);
/// Stack of the thread.
const STACK: usize = 256 * 1024;

/// An address that is taken, and that nothing answers at yet: a program binds it, and then gives up its capabilities.
pub struct Bound(TcpListener);

impl Bound {
    /// Takes the address.
    ///
    /// # Errors
    /// The address is taken, or not this host's.
    pub fn at(address: SocketAddr) -> Result<Self> {
        let bound = TcpListener::bind(address);
        let is_away = bound.as_ref().is_err_and(|error| error.kind() == ErrorKind::AddrNotAvailable);
        let why = if is_away { "no interface that is up has it (`ip address`): " } else { "" };
        let remedy = || format!("cannot listen at {address} ({why}choose another --metrics)");
        bound.map_err(explained).with_context(remedy).map(Self)
    }

    /// Answers from now on, as long as the process lives, with what `figures` says; tells where.
    ///
    /// # Errors
    /// There is no room for a thread.
    pub fn serve(self, figures: impl Fn() -> Option<String> + Send + 'static) -> Result<SocketAddr> {
        let at = self.0.local_addr()?;
        let thread = Builder::new().name("metrics".into()).stack_size(STACK);
        let thread = thread.spawn(move || {
            for client in self.0.incoming() {
                match client {
                    // A client that has gone meanwhile needs no answer.
                    Ok(client) => drop(answer(client, &figures)),
                    Err(_) => std::thread::sleep(REST),
                }
            }
        });
        thread.map_err(explained).context("a thread for figures")?;
        Ok(at)
    }
}

/// Reads an address that no other host reaches.
///
/// # Errors
/// It is no address with a port, or other hosts reach it.
pub fn parse_loopback(text: &str) -> Result<SocketAddr, String> {
    let address: SocketAddr = text
        .parse()
        .map_err(|_| format!("'{text}' is no IP address with a port: write one, as 127.0.0.1:9100"))?;
    if address.ip().is_loopback() {
        return Ok(address);
    }
    let port = address.port();
    Err(format!(
        "other hosts reach {address}, and nothing there asks who reads: write 127.0.0.1:{port}, and let other hosts read it by a \
         reverse proxy or an SSH tunnel (`ssh -L {port}:127.0.0.1:{port} HOST`)"
    ))
}

fn answer(mut client: TcpStream, figures: &impl Fn() -> Option<String>) -> io::Result<()> {
    let deadline = Instant::now() + PATIENCE;
    client.set_write_timeout(Some(PATIENCE))?;
    let (mut head, mut room) = (Vec::new(), [0; 512]);
    while !head.windows(4).any(|end| end == b"\r\n\r\n") && head.len() < HEAD_AT_MOST {
        let left = deadline.saturating_duration_since(Instant::now());
        // A timeout of 0 would be for ever.
        client.set_read_timeout(Some(left.max(Duration::from_millis(1))))?;
        match client.read(&mut room) {
            Ok(length) if length > 0 && !left.is_zero() => head.extend_from_slice(&room[..length]),
            _ => return Ok(()),
        }
    }
    let (status, text) = match (asked(&head), figures()) {
        (Some("/metrics" | "/"), Some(text)) => ("200 OK", text),
        (Some(_), Some(_)) => ("404 Not Found", "figures are at /metrics\n".into()),
        (Some(_), None) => ("503 Service Unavailable", "no answer in time\n".into()),
        (None, _) => ("400 Bad Request", "only GET is answered\n".into()),
    };
    let length = text.len();
    write!(
        client,
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\nContent-Length: {length}\r\nConnection: \
         close\r\n\r\n{text}"
    )
}

/// The path of a GET.
fn asked(head: &[u8]) -> Option<&str> {
    let line = head.split(|byte| *byte == b'\r').next()?;
    let mut words = std::str::from_utf8(line).ok()?.split(' ');
    let path = words.next().filter(|method| *method == "GET").and_then(|_| words.next())?;
    path.split('?').next()
}

/// Lines of figures: text format 0.0.4.
#[derive(Default)]
pub struct Figures(String);

impl Figures {
    /// A figure that goes up and down.
    pub fn gauge(&mut self, [name, help]: [&str; 2], value: impl Display) {
        self.head(name, help, "gauge");
        // A string takes everything.
        let _ = writeln!(self.0, "{name} {value}");
    }

    /// One that only grows.
    pub fn counter(&mut self, [name, help]: [&str; 2], value: impl Display) {
        self.head(name, help, "counter");
        let _ = writeln!(self.0, "{name} {value}");
    }

    /// Several that only grow, distinguished by labels. Their values need no escapes: they are names of this program's.
    pub fn counters<'a, const N: usize>(
        &mut self,
        [name, help]: [&str; 2],
        labels: [&str; N],
        of: impl Iterator<Item = ([&'a str; N], u64)>,
    ) {
        self.head(name, help, "counter");
        for (values, count) in of {
            let pairs = labels.iter().zip(values).map(|(label, value)| format!("{label}=\"{value}\""));
            let _ = writeln!(self.0, "{name}{{{}}} {count}", pairs.collect::<Vec<_>>().join(","));
        }
    }

    /// All lines.
    pub fn into_text(self) -> String {
        self.0
    }

    fn head(&mut self, name: &str, help: &str, kind: &str) {
        let _ = writeln!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Any port of this host.
    const HERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

    fn said(at: SocketAddr, request: &[u8]) -> String {
        let mut client = TcpStream::connect(at).unwrap();
        client.write_all(request).unwrap();
        let mut answer = String::new();
        client.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn figures_are_lines_with_help_and_type() {
        let mut figures = Figures::default();
        figures.gauge(["rtnet_connections", "Open connections."], 3);
        figures.counters(
            ["rtnet_dropped_total", "Packages."],
            ["reason"],
            [(["full"], 7), (["late"], 0)].into_iter(),
        );
        let lines = "# HELP rtnet_connections Open connections.\n# TYPE rtnet_connections gauge\nrtnet_connections 3\n# HELP \
                     rtnet_dropped_total Packages.\n# TYPE rtnet_dropped_total counter\nrtnet_dropped_total{reason=\"full\"} \
                     7\nrtnet_dropped_total{reason=\"late\"} 0\n";
        assert_eq!(figures.into_text(), lines);
    }

    #[test]
    fn figures_have_as_many_labels_as_they_need() {
        let mut figures = Figures::default();
        figures.counters(["x_total", "X."], ["group", "reason"], [(["tcp", "full"], 7)].into_iter());
        assert!(figures.into_text().ends_with("\nx_total{group=\"tcp\",reason=\"full\"} 7\n"));
    }

    #[test]
    fn an_address_that_other_hosts_reach_is_refused() {
        for good in ["127.0.0.1:9100", "127.9.9.9:0", "[::1]:9100"] {
            assert_eq!(parse_loopback(good).unwrap().to_string(), good);
        }
        for open in ["0.0.0.0:9100", "10.0.0.1:9100", "[::]:9100", "[::ffff:127.0.0.1]:9100"] {
            let why = parse_loopback(open).unwrap_err();
            assert!(why.contains(open) && why.contains("write 127.0.0.1:9100"), "{why}");
        }
        for wrong in ["", "9100", "127.0.0.1", "localhost:9100", "127.0.0.1:65536"] {
            let why = parse_loopback(wrong).unwrap_err();
            assert_eq!(why, format!("'{wrong}' is no IP address with a port: write one, as 127.0.0.1:9100"));
        }
    }

    #[test]
    fn a_get_is_answered_and_nothing_else() {
        let at = Bound::at(HERE).unwrap().serve(|| Some("x 1\n".into())).unwrap();
        let good = said(at, b"GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n");
        assert!(
            good.starts_with("HTTP/1.1 200 OK\r\n")
                && good.ends_with("Content-Length: 4\r\nConnection: close\r\n\r\nx 1\n"),
            "{good}"
        );
        assert!(said(at, b"GET /other HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 404"));
        for bad in [&b"POST /metrics HTTP/1.1\r\n\r\n"[..], b"\r\n\r\n", b"\xff\xfe\r\n\r\n", b"GET\r\n\r\n"]
        {
            assert!(said(at, bad).starts_with("HTTP/1.1 400"), "{bad:?}");
        }
        drop(TcpStream::connect(at).unwrap());
        assert!(
            said(at, b"GET / HTTP/1.0\r\n\r\n").starts_with("HTTP/1.1 200"),
            "one that hung up disturbs nobody"
        );
        assert!(Bound::at(at).is_err_and(|error| error.to_string().contains("choose another --metrics")));
    }

    #[test]
    fn a_head_that_never_ends_is_bounded() {
        let at = Bound::at(HERE).unwrap().serve(|| None).unwrap();
        let mut client = TcpStream::connect(at).unwrap();
        let mut answer = String::new();
        // It may have answered, and hung up, before all of it was sent.
        let _ = client.write_all(&[b"GET / ".to_vec(), vec![b'x'; HEAD_AT_MOST]].concat());
        let _ = client.read_to_string(&mut answer);
        assert!(
            answer.is_empty() || answer.starts_with("HTTP/1.1 503") || answer.starts_with("HTTP/1.1 404"),
            "{answer}"
        );
    }
}
