//! What people write for names and patterns.

use core::fmt;

use super::{Class, MailboxName, Pattern};

/// What is no class, name or pattern: what is wrong with it, and how it should be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{text}' is no {}: {why}", .meant.what())]
pub struct NameError {
    text: String,
    meant: Meant,
    why: Why,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Meant {
    Class,
    Name,
    Pattern,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Why {
    Form(Meant),
    Class(String),
    Number(&'static str, String),
    Any(&'static str),
}

/// A place of a pattern: a number, or any.
type Place = Option<u8>;

/// As written, system, class, instance and, if it is there, local.
type Written = ([Place; 3], Option<Place>);

/// Reads a class.
pub fn class(text: &str) -> Result<Class, NameError> {
    class_number(text).map(Class).map_err(|why| NameError { text: text.into(), meant: Meant::Class, why })
}

/// Reads a mailbox's name.
pub fn name(text: &str) -> Result<MailboxName, NameError> {
    let refuse = |why| NameError { text: text.into(), meant: Meant::Name, why };
    let ([system, class, instance], local) = written(text, Meant::Name).map_err(refuse)?;
    let number = |place: Place, what| place.ok_or_else(|| refuse(Why::Any(what)));
    let (system, class) = (number(system, "system")?, Class(number(class, "class")?));
    let (instance, local) = (number(instance, "instance")?, number(local.unwrap_or(Some(0)), "local")?);
    Ok(MailboxName::new(system, class, instance, local))
}

/// Reads a pattern.
pub fn pattern(text: &str) -> Result<Pattern, NameError> {
    let refuse = |why| NameError { text: text.into(), meant: Meant::Pattern, why };
    let ([system, class, instance], local) = written(text, Meant::Pattern).map_err(refuse)?;
    Ok(Pattern::new(system, class.map(Class), instance, local.flatten()))
}

fn written(text: &str, meant: Meant) -> Result<Written, Why> {
    let form = || Why::Form(meant);
    if !text.contains(['.', '(']) {
        let [system, class, instance, local] = whole(text).ok_or_else(form)?.to_be_bytes();
        return Ok(([Some(system), Some(class), Some(instance)], Some(Some(local))));
    }
    let (system, class, instance, local) = places(text).ok_or_else(form)?;
    let local = local.map(|local| any_or(local, |text| number("local", text))).transpose()?;
    let of_module = [
        any_or(system, |text| number("system", text))?,
        any_or(class, class_number)?,
        any_or(instance, |text| number("instance", text))?,
    ];
    Ok((of_module, local))
}

/// `class(system/instance)`, or `system.class.instance`, and a `.local` behind either.
fn places(text: &str) -> Option<(&str, &str, &str, Option<&str>)> {
    if let Some((class, rest)) = text.split_once('(') {
        let (of_module, behind) = rest.split_once(')')?;
        let (system, instance) = of_module.split_once('/')?;
        let local = if behind.is_empty() { None } else { Some(behind.strip_prefix('.')?) };
        return Some((system, class, instance, local));
    }
    let mut parts = text.split('.');
    let places = (parts.next()?, parts.next()?, parts.next()?, parts.next());
    parts.next().is_none().then_some(places)
}

fn any_or(text: &str, place: impl FnOnce(&str) -> Result<u8, Why>) -> Result<Place, Why> {
    if text == "*" { Ok(None) } else { place(text).map(Some) }
}

fn class_number(text: &str) -> Result<u8, Why> {
    let named = Class::NAMED.iter().find(|(_, name)| name.eq_ignore_ascii_case(text));
    match named {
        Some((class, _)) => Ok(class.0),
        None if text.starts_with(|first: char| first.is_ascii_digit()) => number("class", text),
        None => Err(Why::Class(text.into())),
    }
}

fn number(what: &'static str, text: &str) -> Result<u8, Why> {
    let (digits, radix) = hexadecimal(text).map_or((text, 10), |digits| (digits, 16));
    let is_number = !digits.is_empty() && digits.bytes().all(|digit| char::from(digit).is_digit(radix));
    let number = u8::from_str_radix(digits, radix).ok().filter(|_| is_number);
    number.ok_or_else(|| Why::Number(what, text.into()))
}

/// All four places in one number.
fn whole(text: &str) -> Option<u32> {
    let digits = hexadecimal(text).filter(|digits| digits.bytes().all(|digit| digit.is_ascii_hexdigit()))?;
    u32::from_str_radix(digits, 16).ok()
}

fn hexadecimal(text: &str) -> Option<&str> {
    text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"))
}

impl Meant {
    fn what(self) -> &'static str {
        match self {
            Self::Class => "class",
            Self::Name => "mailbox name",
            Self::Pattern => "pattern of mailbox names",
        }
    }
}

impl fmt::Display for Why {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Form(Meant::Pattern) => f.write_str(
                "expected one as 0.Pilot.*, *.Odometry.1.3 or Pilot(0/1), with '*' for any, or 0x00120103; without a local it \
                 is of all mailboxes of a component",
            ),
            Self::Form(_) => f.write_str(
                "expected one as Odometry(0/1) or, of a further mailbox, Odometry(0/1).3, or 0.Odometry.1.3, 0.0x12.1.3 or \
                 0x00120103",
            ),
            Self::Class(text) => {
                write!(f, "no class is called '{text}': there are ")?;
                Class::NAMED.iter().try_for_each(|(_, name)| write!(f, "{name}, "))?;
                f.write_str("and all have numbers, as 0x80")
            }
            Self::Number(what, text) => write!(f, "its {what} is to be 0 to 255, or 0x00 to 0xff, and is '{text}'"),
            Self::Any(what) => write!(f, "its {what} is any, '*', as only a pattern's can be; a mailbox has one: 0 to 255"),
        }
    }
}
