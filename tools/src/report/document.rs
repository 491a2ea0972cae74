//! How every JSON document begins that the command writes: with what it is, and of which version. There is no other way to
//! write one, so that none comes without. `docs/book/json.md` lists them, `docs/schema` has a schema of each.

use serde::de::DeserializeOwned;
use serde::{Serialize, Serializer};
use serde_json::Value;

/// What is written as a document of its own.
pub trait Kind: Serialize {
    /// What it is: the name of its schema, too.
    const KIND: &'static str;
    /// A larger one where a key has gone, or means something else; keys that are added change nothing.
    const VERSION: u32 = 1;
}

/// What a type is as a document; its schema is kept in `docs/schema`, which a test of that name sees to.
macro_rules! document {
    ($of:ty, $kind:literal, $test:ident) => {
        $crate::report::document::document!($of, $kind, 1, $test);
    };
    ($of:ty, $kind:literal, $version:literal, $test:ident) => {
        impl $crate::report::document::Kind for $of {
            const KIND: &'static str = $kind;
            const VERSION: u32 = $version;
        }

        #[cfg(test)]
        #[test]
        fn $test() {
            $crate::report::document::schema::is_kept::<$of>();
        }
    };
}
pub(crate) use document;

/// A document: its kind and version, and then what it says.
#[derive(Serialize)]
pub struct Document<'a, T> {
    kind: &'static str,
    version: u32,
    #[serde(flatten)]
    body: &'a T,
}

impl<'a, T: Kind> Document<'a, T> {
    /// Of this.
    pub fn of(body: &'a T) -> Self {
        Self { kind: T::KIND, version: T::VERSION, body }
    }
}

/// Several of one kind: a list of documents.
pub struct Documents<'a, T>(pub &'a [T]);

impl<T: Kind> Serialize for Documents<'_, T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(Document::of))
    }
}

/// Why a text is no document of a kind.
#[derive(Debug, thiserror::Error)]
pub enum NotRead {
    /// It is no JSON, or not whole.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    /// It is something else, or older or newer.
    #[error("it is {found}, not \"{kind}\" of version {version}")]
    Another {
        /// What it says.
        found: String,
        /// What was to be read.
        kind: &'static str,
        /// In which version.
        version: u32,
    },
}

/// Reads what was written as a document.
///
/// # Errors
/// It is no such document.
pub fn read<T: Kind + DeserializeOwned>(text: &str) -> Result<T, NotRead> {
    let mut value: Value = serde_json::from_str(text)?;
    let mut take = |key| value.as_object_mut().and_then(|all| all.remove(key));
    let (kind, version) = (take("kind"), take("version"));
    if kind != Some(T::KIND.into()) || version != Some(T::VERSION.into()) {
        let words = |of: Option<Value>| of.map_or("none".to_owned(), |of| of.to_string());
        let found = format!("of kind {}, version {}", words(kind), words(version));
        return Err(NotRead::Another { found, kind: T::KIND, version: T::VERSION });
    }
    Ok(serde_json::from_value(value)?)
}

#[cfg(test)]
pub mod schema;

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, Deserialize, PartialEq, Serialize)]
    #[serde(deny_unknown_fields)]
    struct Round {
        sent: u64,
    }

    impl Kind for Round {
        const KIND: &'static str = "round";
    }

    #[test]
    fn a_document_begins_with_its_kind_and_version() {
        let (one, two) = (Round { sent: 7 }, Round { sent: 8 });
        let text = serde_json::to_string(&Document::of(&one)).unwrap();
        assert_eq!(text, "{\"kind\":\"round\",\"version\":1,\"sent\":7}");
        assert_eq!(read::<Round>(&text).unwrap(), one);
        let both = serde_json::to_string(&Documents(&[one, two])).unwrap();
        assert_eq!(both.matches("{\"kind\":\"round\",\"version\":1,\"sent\":").count(), 2);
    }

    #[test]
    fn a_document_of_another_kind_or_version_is_named() {
        let error = |text: &str| read::<Round>(text).unwrap_err().to_string();
        let other = error("{\"kind\": \"ping\", \"version\": 1, \"sent\": 7}");
        assert_eq!(other, "it is of kind \"ping\", version 1, not \"round\" of version 1");
        let newer = error("{\"kind\": \"round\", \"version\": 2, \"sent\": 7}");
        assert_eq!(newer, "it is of kind \"round\", version 2, not \"round\" of version 1");
        assert!(error("{\"sent\": 7}").contains("of kind none"));
        assert!(error("[]").contains("of kind none"));
        assert!(error("{\"kind\": \"round\", \"version\": 1}").contains("missing field"));
    }
}
