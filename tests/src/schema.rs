//! Whether a JSON document is as its schema says: every one that a test reads.

use std::path::{Path, PathBuf};

use boon::{Compiler, Schemas};
use serde_json::Value;

fn schema_of(document: &Value) -> Result<PathBuf, String> {
    let (kind, version) = (document["kind"].as_str(), document["version"].as_u64());
    let (Some(kind), Some(version)) = (kind, version) else {
        return Err(format!("it does not say what it is: {document:#}"));
    };
    let schema = format!("../docs/schema/{kind}.v{version}.json");
    Ok(Path::new(env!("CARGO_MANIFEST_DIR")).join(schema))
}

/// The first violation of its schema by a document, or by one of an array.
pub fn wrong_with(document: &Value) -> Result<(), String> {
    if let Value::Array(documents) = document {
        return documents.iter().try_for_each(wrong_with);
    }
    let path = schema_of(document)?;
    let (mut schemas, mut compiler) = (Schemas::new(), Compiler::new());
    let schema = compiler.compile(&path.display().to_string(), &mut schemas);
    let schema = schema.map_err(|error| format!("{}: {error}", path.display()))?;
    schemas.validate(document, schema).map_err(|error| format!("{error:#}\n{document:#}"))
}

/// The same document, if it is as its schema says.
#[track_caller]
pub fn checked(document: Value) -> Value {
    if let Err(why) = wrong_with(&document) {
        panic!("{why}");
    }
    document
}

/// A document, as text.
#[track_caller]
pub fn read(text: impl AsRef<[u8]>) -> Value {
    checked(serde_json::from_slice(text.as_ref()).expect("JSON"))
}
