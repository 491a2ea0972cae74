//! What of a file there is once, `[medium]`, and what there may be several of, `[[event]]`: the wrong brackets are told of
//! in words of the file, not of what reads it.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::{FileError, Source};

const ONE: [&str; 6] = ["medium", "host", "expect", "clock", "outages", "stalls"];
const SEVERAL: [&str; 5] = ["station", "wire", "event", "traffic", "slots"];

impl Source<'_> {
    /// The file's tables, each in its brackets.
    pub(super) fn tables(&self) -> Result<Spanned<DeTable<'_>>, FileError> {
        let root = DeTable::parse(self.text).map_err(|error| self.no_toml(&error))?;
        self.check_brackets(root.get_ref(), "")?;
        Ok(root)
    }

    /// Of a table, and of those of its stations.
    fn check_brackets(&self, table: &DeTable<'_>, of: &str) -> Result<(), FileError> {
        for (key, value) in table {
            let name: &str = key.get_ref().as_ref();
            let path = format!("{of}{name}");
            let refuse = |what: String| Err(self.impossible(key.span().start, what));
            match value.get_ref() {
                DeValue::Table(_) if SEVERAL.contains(&name) => {
                    return refuse(format!("there may be more than one {name}: it is written [[{path}]]"));
                }
                DeValue::Array(_) if ONE.contains(&name) => {
                    return refuse(format!("there is only one {name}: it is written [{path}]"));
                }
                DeValue::Array(stations) if path == "station" => {
                    for station in stations.iter() {
                        if let DeValue::Table(station) = station.get_ref() {
                            self.check_brackets(station, "station.")?;
                        }
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }
}
