//! Names of mailboxes: whose they are, not where (paper 2.2.2).
//!
//! ```text
//! 31        24        16         8         0
//! +---------+---------+----------+---------+
//! | system  | class   | instance | local   |     Odometry(0/1).3 = 0.Odometry.1.3 = 0.0x12.1.3 = 0x00120103
//! +---------+---------+----------+---------+
//! |         +- a component ------+- 0: its commands; 1 and up: its further mailboxes
//! +- a robot
//! ```

mod file;
mod parse;
mod pattern;

use core::fmt;
use core::str::FromStr;

use serde::{Deserialize, Deserializer};

pub use file::FileError;
pub(crate) use file::Source;
pub use parse::NameError;
pub use pattern::{Pattern, Specificity};

/// The name of a mailbox.
///
/// ```
/// use package_router::name::{Class, MailboxName};
///
/// let name = MailboxName::new(0, Class::ODOMETRY, 1, 3);
/// assert_eq!((name.0, name.to_string()), (0x0012_0103, "Odometry(0/1).3".into()));
/// for written in ["Odometry(0/1).3", "0.odometry.1.3", "0.0x12.1.3", "0x00120103"] {
///     assert_eq!(written.parse(), Ok(name));
/// }
/// ```
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MailboxName(pub u32);

/// What kind of component it is. From 0x80 on they are users' own.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Class(pub u8);

impl MailboxName {
    /// Nobody's, or the router's own where one is asked.
    pub const NOBODY: Self = Self(0);

    /// The mailbox `local` of the component (`class`, `instance`) of a system.
    pub const fn new(system: u8, class: Class, instance: u8, local: u8) -> Self {
        Self(u32::from_be_bytes([system, class.0, instance, local]))
    }

    /// Which robot.
    pub const fn system(self) -> u8 {
        self.0.to_be_bytes()[0]
    }
    /// Which kind of component.
    pub const fn class(self) -> Class {
        Class(self.0.to_be_bytes()[1])
    }
    /// Which of the components of its class.
    pub const fn instance(self) -> u8 {
        self.0.to_be_bytes()[2]
    }
    /// Which of its component's mailboxes: 0 is the one for commands.
    pub const fn local(self) -> u8 {
        self.0.to_be_bytes()[3]
    }
    /// Another mailbox of the same component.
    pub const fn with_local(self, local: u8) -> Self {
        Self(self.0 & !0xff | local as u32)
    }
}

macro_rules! classes {
    ($($id:literal $constant:ident $name:literal),+ $(,)?) => {
        impl Class {
            $(#[doc = concat!("`", $name, "`.")]
            pub const $constant: Self = Self($id);)+

            /// All that have names, in the order of their numbers.
            pub const NAMED: &[(Self, &str)] = &[$((Self::$constant, $name)),+];
        }
    };
}

classes! {
    0x00 SYSTEM "System", 0x01 GDOS "GDOS", 0x02 GUI "GUI",
    0x10 TEST "Test", 0x11 CHASSIS "Chassis", 0x12 ODOMETRY "Odometry", 0x13 POSITION "Position",
    0x14 LADAR "Ladar", 0x15 CAMERA "Camera", 0x16 GPS "Gps", 0x17 JOYSTICK "Joystick",
    0x18 PILOT "Pilot", 0x19 SCAN2D "Scan2d", 0x1a DATALOG "Datalog", 0x1b OBJ_RECOG "ObjRecog",
    0x1c CLOCK "Clock", 0x1d VEHICLE "Vehicle", 0x1e GYRO "Gyro", 0x1f IO "Io",
    0x20 SERVO_DRIVE "ServoDrive", 0x21 SCAN3D "Scan3d", 0x22 PLANNER "Planner", 0x23 FEATURE_MAP "FeatureMap",
    0x24 GRID_MAP "GridMap", 0x25 PATH "Path", 0x26 MCL "Mcl", 0x27 PTZ_DRIVE "PtzDrive",
    0x28 COMPASS "Compass",
}

impl Class {
    /// What it is called, if it is.
    pub fn name(self) -> Option<&'static str> {
        Self::NAMED.iter().find(|(class, _)| *class == self).map(|(_, name)| *name)
    }
}

impl fmt::Display for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.name() {
            Some(name) => f.write_str(name),
            None => write!(f, "{:#04x}", self.0),
        }
    }
}

impl fmt::Debug for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Display for MailboxName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}({}/{})", self.class(), self.system(), self.instance())?;
        match self.local() {
            0 => Ok(()),
            local => write!(f, ".{local}"),
        }
    }
}

impl fmt::Debug for MailboxName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// By its name, in capitals or not, or by its number, decimal or as 0x80.
impl FromStr for Class {
    type Err = NameError;

    fn from_str(text: &str) -> Result<Self, NameError> {
        parse::class(text)
    }
}

/// What is displayed, `0.Odometry.1.3`, and `0x00120103`. Where no local is said, it is 0.
impl FromStr for MailboxName {
    type Err = NameError;

    fn from_str(text: &str) -> Result<Self, NameError> {
        parse::name(text)
    }
}

impl<'de> Deserialize<'de> for Class {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from_text(from)
    }
}

impl<'de> Deserialize<'de> for MailboxName {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from_text(from)
    }
}

impl<'de> Deserialize<'de> for Pattern {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from_text(from)
    }
}

fn from_text<'de, T: FromStr<Err = NameError>, D: Deserializer<'de>>(from: D) -> Result<T, D::Error> {
    String::deserialize(from)?.parse().map_err(serde::de::Error::custom)
}

#[cfg(test)]
mod tests;
