//! Many mailboxes at once.

use core::fmt;
use core::str::FromStr;

use super::{Class, MailboxName, NameError, parse};

/// All mailboxes whose names have certain places; the others may be any.
///
/// ```
/// use package_router::name::{MailboxName, Pattern};
///
/// let pilots: Pattern = "0.Pilot.*".parse()?;
/// assert!(pilots.matches("Pilot(0/7).2".parse()?) && !pilots.matches("Pilot(1/7)".parse()?));
///
/// let seventh: Pattern = "Pilot(0/7)".parse()?;
/// assert!(seventh.specificity() > pilots.specificity());
/// # Ok::<(), package_router::name::NameError>(())
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Pattern {
    /// Which bits of a name count: those of whole places.
    mask: u32,
    /// What they are; the others are 0.
    value: u32,
}

/// How much a pattern says. Of all that match a name, exactly one says most: of equally many places those further left are more.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Specificity {
    bits: u32,
    mask: u32,
}

impl Pattern {
    /// All mailboxes with these places; `None` is any.
    pub const fn new(
        system: Option<u8>,
        class: Option<Class>,
        instance: Option<u8>,
        local: Option<u8>,
    ) -> Self {
        let class = match class {
            Some(Class(class)) => Some(class),
            None => None,
        };
        let ((s, system), (c, class)) = (place(system), place(class));
        let ((i, instance), (l, local)) = (place(instance), place(local));
        Self {
            mask: u32::from_be_bytes([s, c, i, l]),
            value: u32::from_be_bytes([system, class, instance, local]),
        }
    }

    /// Its system; `None` is any.
    pub const fn system(self) -> Option<u8> {
        let ([is_named, ..], [system, ..]) = (self.mask.to_be_bytes(), self.value.to_be_bytes());
        if is_named == 0 { None } else { Some(system) }
    }

    /// As a number, for who passes it on.
    pub const fn to_bits(self) -> u64 {
        (self.mask as u64) << 32 | self.value as u64
    }

    /// The reverse; `None`: it is none.
    pub fn from_bits(bits: u64) -> Option<Self> {
        let (mask, value) = ((bits >> 32) as u32, bits as u32);
        let is_mask = mask.to_be_bytes().into_iter().all(|byte| byte == 0 || byte == 0xff);
        (is_mask && value & !mask == 0).then_some(Self { mask, value })
    }

    /// One mailbox and no other.
    pub const fn exact(name: MailboxName) -> Self {
        Self { mask: u32::MAX, value: name.0 }
    }

    /// Whether it is of one mailbox.
    pub const fn is_exact(&self) -> bool {
        self.mask == u32::MAX
    }

    /// Whether a mailbox is among those that are meant.
    #[inline]
    pub const fn matches(&self, name: MailboxName) -> bool {
        name.0 & self.mask == self.value
    }

    /// How much it says: more wins.
    pub const fn specificity(&self) -> Specificity {
        Specificity { bits: self.mask.count_ones(), mask: self.mask }
    }

    /// System, class, instance and local.
    fn places(&self) -> [Option<u8>; 4] {
        let (mask, value) = (self.mask.to_be_bytes(), self.value.to_be_bytes());
        core::array::from_fn(|at| (mask[at] != 0).then_some(value[at]))
    }
}

const fn place(place: Option<u8>) -> (u8, u8) {
    match place {
        Some(number) => (0xff, number),
        None => (0, 0),
    }
}

impl From<MailboxName> for Pattern {
    fn from(name: MailboxName) -> Self {
        Self::exact(name)
    }
}

impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [system, class, instance, local] = self.places();
        write!(f, "{}.{}.{}", Shown(system), Shown(class.map(Class)), Shown(instance))?;
        match local {
            Some(local) => write!(f, ".{local}"),
            None => Ok(()),
        }
    }
}

struct Shown<T>(Option<T>);

impl<T: fmt::Display> fmt::Display for Shown<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(place) => place.fmt(f),
            None => f.write_str("*"),
        }
    }
}

impl fmt::Debug for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// All forms of a name, with `*` for any place. Where no local is said, it is any.
impl FromStr for Pattern {
    type Err = NameError;

    fn from_str(text: &str) -> Result<Self, NameError> {
        parse::pattern(text)
    }
}
