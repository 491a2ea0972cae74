//! The JSON of runs and plans against its schemas.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;

use crate::rtnet;
use crate::schema::{read, wrong_with};

/// What needs no kernel: of runs in virtual time and of plans.
fn documents() -> BTreeMap<String, Value> {
    let dir = tempfile::tempdir().unwrap();
    let ring = dir.path().join("ring.toml");
    std::fs::write(&ring, RING).unwrap();
    let cell = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli/html.toml");
    let report = dir.path().join("report.json");
    let mut all = BTreeMap::new();
    let (run, seeds, plan) = (&["sim", "run"][..], &["sim", "run", "--seeds", "1..2"][..], &["plan"][..]);
    for (verb, file) in [(run, &cell), (run, &ring), (seeds, &cell), (plan, &cell), (plan, &ring)] {
        let mut command = rtnet();
        command.args(verb).arg(file).arg("--json");
        if verb != plan {
            command.arg(&report);
        }
        let output = command.output().unwrap();
        let document = read(if verb == plan { output.stdout } else { std::fs::read(&report).unwrap() });
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
    assert_eq!(kinds, ["plan", "ring-plan", "ring-run", "sim-run", "sim-seeds"]);
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
