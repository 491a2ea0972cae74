//! How urgent packages and components are: by the class of who sends, for the whole system from one file (paper 2.2.2, 4.2).
//!
//! ```text
//! class of the sender ─► package priority 0..255 ─► transmit level 0..30
//! 0x18 Pilot             247                         1                    by the rule: the class's highest 4 bits
//!                        larger is more urgent       0 is the most urgent; 31 is never a package's
//! ```
//!
//! One fixed function leads from the priority to the level, so a reply, which keeps its command's priority, keeps the level, too.
//! Whoever wants other priorities says so in a file:
//!
//! ```
//! use package_router::name::Class;
//! use package_router::priority::Priorities;
//!
//! let priorities = Priorities::parse(
//!     r#"
//!         [class.Pilot]   # its name, or [class.0x18]
//!         task = 70       # SCHED_FIFO priority of its tasks, 1 to 99; default: none is said
//!         package = 231   # priority of its packages, 0 to 255
//!         channel = 2     # the slot that its packages leave in; default: 0
//!
//!         [class.0x80]
//!         level = 3       # instead of package: the transmit level, 0 to 30
//!     "#,
//!     "priorities.toml",
//! )?;
//! assert_eq!((priorities.task(Class::PILOT), priorities.package(Class::PILOT)), (Some(70), 231));
//! assert_eq!((priorities.level(Class::PILOT).level(), priorities.channel(Class::PILOT)), (3, 2));
//! assert_eq!(priorities.level(Class(0x80)).level(), 3);
//! assert_eq!(priorities.level(Class::GYRO).level(), 1, "nothing is said: the rule");
//! # Ok::<(), package_router::name::FileError>(())
//! ```

use core::ops::RangeInclusive;
use std::collections::BTreeMap;

use rtnet::Priority;
use rtnet::discipline::Channel;
use serde::Deserialize;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::name::{Class, FileError, Source};

/// As many priorities of packages go to one transmit level as make 32 of 256.
const PER_LEVEL: u8 = 8;
const CLASSES: usize = 256;
/// What Linux takes for SCHED_FIFO.
const TASK: RangeInclusive<u8> = 1..=99;
const ANY: RangeInclusive<u8> = 0..=255;
const LEVEL: RangeInclusive<u8> = 0..=Priority::LAST_REAL_TIME.level();

/// The transmit level of a package of that priority.
#[inline]
pub fn level_of(priority: u8) -> Priority {
    let level = (u8::MAX - priority) / PER_LEVEL;
    // The last level is not for packages: the least urgent share the one before.
    Priority::new(level).unwrap_or(Priority::LAST_REAL_TIME).min(Priority::LAST_REAL_TIME)
}

/// The priority of packages that are to leave at that level, the most urgent of those that do.
pub const fn priority_of_level(level: Priority) -> u8 {
    let last = Priority::LAST_REAL_TIME.level();
    let level = if level.level() < last { level.level() } else { last };
    u8::MAX - PER_LEVEL * level
}

/// The priority of a class's packages where nothing is said of it: its highest 4 bits are the level.
pub const fn of_class(class: Class) -> u8 {
    u8::MAX - PER_LEVEL * (class.0 >> 4)
}

/// What is said of all classes: a table, of which a look-up is one read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Priorities {
    classes: [OfClass; CLASSES],
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct OfClass {
    task: Option<u8>,
    package: u8,
    channel: Channel,
}

/// Without a file: the rule, for all classes.
impl Default for Priorities {
    fn default() -> Self {
        let rule = |class| OfClass { package: of_class(Class(class as u8)), ..OfClass::default() };
        Self { classes: core::array::from_fn(rule) }
    }
}

impl Priorities {
    /// Reads what `text` says, of a file that messages call `file`. Of classes that it does not name the rule holds.
    pub fn parse(text: &str, file: &str) -> Result<Self, FileError> {
        let source = Source { file, text };
        let tables = source.tables()?;
        check_brackets(&source, tables.get_ref())?;
        let PriorityFile { class: entries } = source.read(tables)?;
        let mut entries: Vec<_> = entries.into_iter().collect();
        entries.sort_by_key(|(key, _)| key.span().start);

        let mut priorities = Self::default();
        let mut said: BTreeMap<Class, usize> = BTreeMap::new();
        for (key, entry) in &entries {
            let at = key.span().start;
            let class: Class = key.get_ref().parse().map_err(|error| source.wrong(at, error))?;
            if let Some(before) = said.insert(class, at) {
                let line = source.line(before);
                return Err(
                    source.wrong(at, format!("{class} stands in line {line} already: name a class once"))
                );
            }
            let of_class = &mut priorities.classes[usize::from(class.0)];
            *of_class = entry.read(&source, *of_class)?;
        }
        Ok(priorities)
    }

    /// The priority that packages of a class are sent with: larger is more urgent.
    #[inline]
    pub fn package(&self, class: Class) -> u8 {
        self.of(class).package
    }

    /// The level at which they leave.
    #[inline]
    pub fn level(&self, class: Class) -> Priority {
        level_of(self.package(class))
    }

    /// The slot that they leave in.
    #[inline]
    pub fn channel(&self, class: Class) -> Channel {
        self.of(class).channel
    }

    /// The SCHED_FIFO priority, 1 to 99, of the tasks of a class, if one is said.
    pub fn task(&self, class: Class) -> Option<u8> {
        self.of(class).task
    }

    #[inline]
    fn of(&self, class: Class) -> &OfClass {
        &self.classes[usize::from(class.0)]
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PriorityFile {
    #[serde(default)]
    class: BTreeMap<Spanned<String>, ClassFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ClassFile {
    task: Option<Spanned<i64>>,
    package: Option<Spanned<i64>>,
    level: Option<Spanned<i64>>,
    channel: Option<Spanned<i64>>,
}

/// What is no table would be read as one by the order of what it holds.
fn check_brackets(source: &Source<'_>, file: &DeTable<'_>) -> Result<(), FileError> {
    let Some(DeValue::Table(classes)) = file.get("class").map(Spanned::get_ref) else { return Ok(()) };
    let wrong = classes.iter().find(|(_, value)| !value.get_ref().is_table());
    wrong.map_or(Ok(()), |(key, _)| {
        let class = key.get_ref();
        Err(source
            .wrong(key.span().start, format!("what is said of a class stands below [class.{class}], once")))
    })
}

impl ClassFile {
    /// What it says of a class, of which the rule is `default`.
    fn read(&self, source: &Source<'_>, default: OfClass) -> Result<OfClass, FileError> {
        let number = |value: &Option<Spanned<i64>>, within: RangeInclusive<u8>, what: &str| {
            let Some(value) = value else { return Ok(None) };
            let number = u8::try_from(*value.get_ref()).ok().filter(|number| within.contains(number));
            let wrong = || {
                let (least, most) = within.into_inner();
                source
                    .wrong(value.span().start, format!("{} is no {what}: {least} to {most}", value.get_ref()))
            };
            number.map(Some).ok_or_else(wrong)
        };
        let package = number(&self.package, ANY, "priority of packages (larger is more urgent)")?;
        let level = number(&self.level, LEVEL, "transmit level of packages (0 is the most urgent)")?;
        if let (Some(package), Some(level)) = (&self.package, &self.level) {
            let at = package.span().start.max(level.span().start);
            let what = "package and level of one class: the level follows from the priority of packages; leave one of them out";
            return Err(source.wrong(at, what));
        }
        let of_level = level.and_then(|level| Priority::new(level).ok()).map(priority_of_level);
        Ok(OfClass {
            task: number(&self.task, TASK, "SCHED_FIFO priority of tasks")?,
            package: package.or(of_level).unwrap_or(default.package),
            channel: number(&self.channel, ANY, "channel, which is the id of a slot")?
                .unwrap_or(default.channel),
        })
    }
}

#[cfg(test)]
mod tests;
