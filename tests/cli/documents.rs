//! Every JSON document that a test reads is as its schema says.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use boon::{Compiler, Schemas};
use serde_json::Value;

use crate::rtnet;

fn schema_of(document: &Value) -> Result<PathBuf, String> {
    let (kind, version) = (document["kind"].as_str(), document["version"].as_u64());
    let (Some(kind), Some(version)) = (kind, version) else {
        return Err(format!("it does not say what it is: {document:#}"));
    };
    let schema = format!("../docs/schema/{kind}.v{version}.json");
    Ok(Path::new(env!("CARGO_MANIFEST_DIR")).join(schema))
}

/// What is wrong with a document, or with one of an array.
fn wrong_with(document: &Value) -> Result<(), String> {
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

/// What needs no kernel: of runs in virtual time and of plans.
fn documents() -> BTreeMap<String, Value> {
    let dir = tempfile::tempdir().unwrap();
    let ring = dir.path().join("ring.toml");
    std::fs::write(&ring, RING).unwrap();
    let cell = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli/html.toml");
    let report = dir.path().join("report.json");
    let mut all = BTreeMap::new();
    for (verb, file) in [("sim", &cell), ("sim", &ring), ("plan", &cell), ("plan", &ring)] {
        let mut command = rtnet();
        match verb {
            "sim" => command.args(["sim", "run"]).arg(file).arg("--json").arg(&report),
            _ => command.arg("plan").arg(file).arg("--json"),
        };
        let output = command.output().unwrap();
        let written = if verb == "sim" { std::fs::read(&report).unwrap() } else { output.stdout };
        let document = read(written);
        all.insert(document["kind"].as_str().unwrap().to_owned(), document);
    }
    all
}

const RING: &str = r#"
discipline = "token"
duration = "100ms"
[[station]]
name = "a"
[[station]]
name = "b"
"#;

#[test]
fn reports_are_as_their_schemas_say() {
    let all = documents();
    let kinds: Vec<&str> = all.keys().map(String::as_str).collect();
    assert_eq!(kinds, ["plan", "ring-plan", "ring-run", "sim-run"]);
    for (kind, document) in &all {
        let text = document.to_string();
        assert!(text.contains("\"kind\"") && wrong_with(document) == Ok(()), "{kind}");
        // A key that has gone, is misspelt, or holds something else is found; one that is new is not.
        for key in document.as_object().unwrap().keys() {
            let mut changed = document.clone();
            let value = changed.as_object_mut().unwrap().remove(key).unwrap();
            changed[format!("{key}x")] = value;
            assert!(wrong_with(&changed).is_err(), "{kind}: {key} has gone");
            changed[key] = Value::Array(vec![Value::Array(Vec::new())]);
            assert!(wrong_with(&changed).is_err(), "{kind}: {key} is something else");
        }
        let mut more = document.clone();
        more["new"] = 7.into();
        assert_eq!(wrong_with(&more), Ok(()), "{kind}");
    }
}

#[test]
fn documents_begin_with_kind_and_version() {
    let output = rtnet().args(["plan", "--stations", "2", "--cycle", "1ms", "--json"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.starts_with("{\n  \"kind\": \"plan\",\n  \"version\": 1,\n"), "{text}");
}

/// Who adds a kind says so in the book; and what is there has a schema.
#[test]
fn every_schema_has_its_kind_in_the_book() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let book = std::fs::read_to_string(root.join("docs/book/json.md")).unwrap();
    let schemas = std::fs::read_dir(root.join("docs/schema")).unwrap();
    let mut kinds: Vec<String> = schemas
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .map(|name| name.split_once('.').expect("KIND.v1.json").0.to_owned())
        .collect();
    kinds.sort();
    assert!(kinds.len() > 20, "{kinds:?}");
    let table = book.split("## Kinds").nth(1).unwrap();
    let rows = table.lines().filter(|line| line.starts_with("| `"));
    let first = |row: &str| row.split('|').nth(1).unwrap().replace(['`', ' '], "");
    let mut said: Vec<String> =
        rows.flat_map(|row| first(row).split(',').map(str::to_owned).collect::<Vec<_>>()).collect();
    said.sort();
    assert_eq!(kinds, said);
}
