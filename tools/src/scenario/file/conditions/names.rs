//! Stations by their names: one, or several, each where it stands.

use std::fmt;

use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};
use toml::Spanned;

use super::Reader;
use crate::scenario::file::FileError;

/// So many stations are named to who has named one that there is not.
const NAMED: usize = 20;

/// One station, or several.
#[derive(Clone)]
pub enum Names {
    One(String),
    Several(Vec<Spanned<String>>),
}

impl<'de> Deserialize<'de> for Names {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Either)
    }
}

struct Either;

impl<'de> Visitor<'de> for Either {
    type Value = Names;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a station's name, or a list of names")
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<Names, E> {
        Ok(Names::One(name.into()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut names: A) -> Result<Names, A::Error> {
        let mut all = Vec::new();
        while let Some(name) = names.next_element()? {
            all.push(name);
        }
        Ok(Names::Several(all))
    }
}

impl Reader<'_> {
    /// Their numbers, each once.
    pub(super) fn stations(&self, names: &Spanned<Names>) -> Result<Vec<usize>, FileError> {
        let at = names.span().start;
        let numbers: Result<Vec<_>, _> = match names.get_ref() {
            Names::One(name) => std::iter::once(self.number(name, at)).collect(),
            Names::Several(names) => {
                names.iter().map(|name| self.number(name.get_ref(), name.span().start)).collect()
            }
        };
        let mut numbers = numbers?;
        if numbers.is_empty() {
            return Err(self.source.impossible(at, "no station is named: name one, or several"));
        }
        numbers.sort_unstable();
        numbers.dedup();
        Ok(numbers)
    }

    /// The number of one that is named there.
    pub(super) fn number(&self, name: &str, at: usize) -> Result<usize, FileError> {
        let number = self.names.iter().position(|of| *of == name);
        number.ok_or_else(|| {
            let (some, more) = (self.names.iter().take(NAMED), self.names.len().saturating_sub(NAMED));
            let some = some.copied().collect::<Vec<_>>().join(", ");
            let more = if more > 0 { format!(" and {more} more") } else { String::new() };
            self.source.impossible(at, format!("there is no station '{name}': there are {some}{more}"))
        })
    }
}
