//! What went wrong, of each thread: kept as it is, and put into words when somebody asks.

use core::ffi::c_char;
use core::fmt;
use std::cell::RefCell;
use std::ffi::CString;

use package_router::component::{Error, ReceiveError, SendError};
use package_router::mailbox;
use package_router::name::MailboxName;
use package_router::registry::Refused;
use package_router::tcp::address::NoAddress;
use package_router::tcp::keys::KeysError;

/// What went wrong.
#[derive(Debug)]
pub enum Failure {
    /// NULL, or a pointer that cannot be one: of which argument.
    NoPointer(&'static str),
    /// A length that nothing has.
    Len(&'static str, u32),
    /// A number that means nothing.
    Number(&'static str, u32),
    /// A package is lent.
    Lent(MailboxName),
    /// None is.
    NotLent(MailboxName),
    /// There is no package, of a receive that does not wait.
    Nothing(MailboxName),
    /// Between the component and its station: about which place or mailbox.
    Station(String, Error),
    /// Text that is no address of a TCP router.
    Router(NoAddress),
    /// Keys that cannot be used.
    Keys(KeysError),
    /// A component of a station, of which a router was asked for.
    OfStation,
    /// Of a send.
    Send(MailboxName, SendError),
    /// Of a receive.
    Receive(MailboxName, ReceiveError),
    /// Room that is too small for the body.
    TooSmall(MailboxName, mailbox::TooSmall),
    /// A panic, which ends here.
    Panicked,
}

struct Last {
    place: &'static str,
    failure: Failure,
}

thread_local! {
    static LAST: RefCell<Option<Last>> = const { RefCell::new(None) };
    static WORDS: RefCell<CString> = RefCell::new(CString::default());
}

/// Keeps it for who asks, and is what the function returns.
pub fn keep(place: &'static str, failure: Failure) -> i32 {
    let errno = failure.errno();
    // A thread that is ending asks no more.
    let _ = LAST.try_with(|last| last.replace(Some(Last { place, failure })));
    -errno
}

/// Of this thread, in words; they stay until it is called again.
pub fn words() -> *const c_char {
    let said = LAST.try_with(|last| last.borrow().as_ref().map_or(String::new(), Last::to_string));
    let said = CString::new(said.unwrap_or_default().replace('\0', "?")).unwrap_or_default();
    WORDS
        .try_with(|words| {
            words.replace(said);
            words.borrow().as_ptr()
        })
        .unwrap_or(c"".as_ptr())
}

impl Failure {
    fn errno(&self) -> i32 {
        match self {
            Self::NoPointer(_) | Self::Number(..) | Self::Router(_) | Self::Len("room", _) => libc::EINVAL,
            Self::Keys(KeysError::Unreadable(_, error)) => error.raw_os_error().unwrap_or(libc::EIO),
            Self::Keys(_) => libc::EINVAL,
            Self::OfStation => libc::EOPNOTSUPP,
            Self::Len(..) | Self::TooSmall(..) => libc::EMSGSIZE,
            Self::Lent(_) => libc::EBUSY,
            Self::NotLent(_) => libc::ENOMSG,
            Self::Nothing(_) => libc::EAGAIN,
            Self::Station(_, error) => of_station(error),
            Self::Send(_, error) => of_send(error),
            Self::Receive(_, ReceiveError::TimedOut) => libc::ETIMEDOUT,
            Self::Receive(_, ReceiveError::Gone) => libc::ENODEV,
            Self::Receive(_, ReceiveError::TooSmall(_)) => libc::EMSGSIZE,
            Self::Panicked => libc::ENOTRECOVERABLE,
        }
    }
}

fn of_station(error: &Error) -> i32 {
    match error {
        Error::Refused(Refused::Taken(_)) => libc::EEXIST,
        Error::Refused(Refused::TooMany) => libc::ENOSPC,
        Error::Refused(Refused::NoMailbox(_)) => libc::ENOENT,
        Error::Refused(Refused::NotOwn(_)) => libc::EPERM,
        Error::Refused(Refused::NoLane(..)) => libc::EUSERS,
        Error::Io(error) => error.raw_os_error().filter(|&errno| errno > 0).unwrap_or(libc::EIO),
        _ => libc::EINVAL,
    }
}

fn of_send(error: &SendError) -> i32 {
    match error {
        SendError::Mailbox(mailbox::SendError::Full(_)) => libc::ENOBUFS,
        SendError::Mailbox(mailbox::SendError::TooLarge { .. }) | SendError::LongerThanTcpTakes { .. } => {
            libc::EMSGSIZE
        }
        SendError::Mailbox(_) => libc::EPROTO,
        SendError::NoMailbox(_) => libc::ENOENT,
        SendError::Unbound(_) => libc::EBADF,
        SendError::Station(errno) if *errno > 0 => *errno,
        SendError::Station(_) => libc::EIO,
    }
}

impl fmt::Display for Last {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} in {}: ", ErrnoName(self.failure.errno()), self.place)?;
        match &self.failure {
            Failure::NoPointer(what) => write!(f, "`{what}` points nowhere: give it something that is there"),
            Failure::Router(error) => write!(f, "{error}"),
            Failure::Keys(error) => write!(f, "{error}"),
            Failure::OfStation => {
                f.write_str("this component is of a station, which has the connection: `rtnet stat` shows it")
            }
            Failure::Len(what, len) => {
                let most = mailbox::LARGEST_BODY;
                write!(f, "`{what}` is {len}: bodies have {most} bytes at the most, so give no more")
            }
            Failure::Number(what, number) => write!(f, "`{what}` is {number}: it is 0 or 1"),
            Failure::Lent(of) => write!(f, "{of}: a package is lent: release it, or put it back, first"),
            Failure::NotLent(of) => write!(f, "{of}: no package is lent: peek at one first"),
            Failure::Nothing(of) => write!(f, "{of}: nothing waits: come again, or wait for it"),
            Failure::Station(about, error) => {
                write!(f, "{about}: {error}")?;
                f.write_str(remedy(error))
            }
            Failure::Send(to, SendError::Mailbox(error @ mailbox::SendError::Full(_))) => {
                write!(f, "to {to}: {error}: send less, or let its owner read it or have more slots")
            }
            Failure::Send(to, SendError::Mailbox(error @ mailbox::SendError::TooLarge { .. })) => {
                write!(f, "to {to}: {error}: send less at a time, or let its owner have larger ones")
            }
            Failure::Send(to, error) => write!(f, "to {to}: {error}"),
            Failure::Receive(of, error @ ReceiveError::TimedOut) => {
                write!(f, "{of}: {error}: wait longer, or look whether its senders live")
            }
            Failure::Receive(of, error @ ReceiveError::Gone) => {
                write!(f, "{of}: {error}: attach to it again once it runs")
            }
            Failure::Receive(of, error) => write!(f, "{of}: {error}"),
            Failure::TooSmall(of, error) => write!(f, "{of}: {error}: receive with that much room"),
            Failure::Panicked => f.write_str(
                "the library has panicked, and said why to standard error: destroy this handle, and report that",
            ),
        }
    }
}

/// What to do about it, where it does not say so itself.
fn remedy(error: &Error) -> &'static str {
    match error {
        Error::Refused(Refused::NoMailbox(_)) => ": start the component that has it, or add a route to it",
        Error::Io(_) => ": look whether the station runs, and whether this is the path of its broker",
        _ => "",
    }
}

/// As `errno.h` calls it, if it is one of those that are likely.
struct ErrnoName(i32);

impl fmt::Display for ErrnoName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = match self.0 {
            libc::EINVAL => "EINVAL",
            libc::EMSGSIZE => "EMSGSIZE",
            libc::EBUSY => "EBUSY",
            libc::ENOMSG => "ENOMSG",
            libc::EAGAIN => "EAGAIN",
            libc::ETIMEDOUT => "ETIMEDOUT",
            libc::ENODEV => "ENODEV",
            libc::ENOTRECOVERABLE => "ENOTRECOVERABLE",
            libc::EEXIST => "EEXIST",
            libc::ENOSPC => "ENOSPC",
            libc::ENOENT => "ENOENT",
            libc::EPERM => "EPERM",
            libc::EUSERS => "EUSERS",
            libc::ENOBUFS => "ENOBUFS",
            libc::EPROTO => "EPROTO",
            libc::EIO => "EIO",
            libc::ECONNREFUSED => "ECONNREFUSED",
            libc::ECONNRESET => "ECONNRESET",
            libc::EACCES => "EACCES",
            libc::EOPNOTSUPP => "EOPNOTSUPP",
            other => return write!(f, "errno {other}"),
        };
        f.write_str(name)
    }
}

/// For tests: what this thread would be told.
#[cfg(test)]
#[allow(unsafe_code)]
pub fn said() -> String {
    // SAFETY: they end with a zero, and live until this thread asks again.
    unsafe { core::ffi::CStr::from_ptr(words()) }.to_str().unwrap_or_default().to_owned()
}
