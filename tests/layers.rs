//! Who may know whom, what may be depended on, and that protocol code is pure.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use cargo_metadata::{CargoOpt, Metadata, MetadataCommand, Package};

/// Our crates and which of ours they may depend on.
const LAYERS: &[(&str, &[&str])] = &[
    ("rtnet", &[]),
    ("rtmac", &["rtnet"]),
    ("vnic", &["rtnet", "rtmac"]),
    ("package-router", &["rtnet"]),
    ("package-router-c", &["package-router", "rtnet"]),
    ("rtnet-tools", &["rtnet", "rtmac", "vnic", "package-router"]),
    ("tests", &["rtnet", "rtmac", "vnic", "package-router", "rtnet-tools"]),
];

/// Licences that ask for no more than being named.
const PERMISSIVE: &[&str] = &[
    "0BSD",
    "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "CC0-1.0",
    "ISC",
    "MIT",
    "MIT-0",
    "MPL-2.0",
    "Unicode-3.0",
    "Unicode-DFS-2016",
    "Unlicense",
    "Zlib",
];

/// What protocol code never says: clocks, sleeping, the network, chance, and an order that differs from
/// run to run.
const IMPURE: &[&str] = &[
    "Instant::now",
    "SystemTime",
    "thread::sleep",
    "HashMap",
    "HashSet",
    "std::net",
    "rand::",
    "std::fs",
    "std::env",
    "std::process",
];

/// Dependencies for this kind of machine, as the lock file has them.
fn metadata() -> Metadata {
    let mut command = MetadataCommand::new();
    command.manifest_path(Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml"));
    command.features(CargoOpt::AllFeatures);
    let platform = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    command.other_options(["--locked".to_owned(), "--filter-platform".to_owned(), platform]);
    command.exec().expect("cargo metadata")
}

#[test]
fn dependencies_run_one_way() {
    let metadata = metadata();
    let may: BTreeMap<_, _> = LAYERS.iter().copied().collect();
    let ours: BTreeSet<String> = metadata.workspace_packages().iter().map(|p| p.name.to_string()).collect();
    for package in metadata.workspace_packages() {
        let name = package.name.as_str();
        let allowed = may.get(name).unwrap_or_else(|| panic!("{name} has no place among the layers"));
        for on in package.dependencies.iter().filter(|on| ours.contains(&on.name)) {
            assert!(allowed.contains(&on.name.as_str()), "{name} must not depend on {}", on.name);
        }
    }
}

#[test]
fn every_dependency_is_permissive_and_from_the_registry() {
    let metadata = metadata();
    let ours: BTreeSet<_> = metadata.workspace_members.iter().collect();
    let used: BTreeSet<_> =
        metadata.resolve.as_ref().expect("a resolved graph").nodes.iter().map(|n| &n.id).collect();
    let foreign = |p: &&Package| used.contains(&p.id) && !ours.contains(&p.id);
    let mut seen = 0;
    for package in metadata.packages.iter().filter(foreign) {
        let licence = package.license.as_deref().unwrap_or("none");
        assert!(is_permissive(licence), "{} {}: licence {licence}", package.name, package.version);
        let from_registry = package.source.as_ref().is_some_and(|source| source.is_crates_io());
        assert!(from_registry, "{} {} is not from the registry", package.name, package.version);
        seen += 1;
    }
    assert!(seen > 20, "only {seen} dependencies were looked at");
}

#[test]
fn licence_expressions_are_understood() {
    for fine in ["MIT", "MIT/Apache-2.0", "GPL-2.0 OR MIT", "(MIT OR Apache-2.0) AND Unicode-3.0"] {
        assert!(is_permissive(fine), "{fine}");
    }
    for not in ["none", "GPL-2.0", "MIT AND GPL-2.0", "(MIT OR Zlib) AND LGPL-2.1"] {
        assert!(!is_permissive(not), "{not}");
    }
}

#[test]
fn protocol_code_is_pure() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace");
    let mut looked_at = 0;
    for sources in ["rtnet/src", "rtmac/src", "vnic/src", "package-router/src"] {
        for file in rust_files(&root.join(sources)) {
            // The shells: what opens sockets and devices or waits, and the simulator around the protocol.
            let shell = [
                "rtnet/src/live",
                "rtnet/src/api",
                "rtnet/src/sim",
                "vnic/src/netlink",
                "vnic/src/tun.rs",
                "vnic/src/tun",
                "package-router/src/broker.rs",
                "package-router/src/component.rs",
                "package-router/src/component",
                "package-router/src/bells.rs",
                "package-router/src/node.rs",
                "package-router/src/tcp/client.rs",
                "package-router/src/tcp/dial.rs",
                "package-router/src/tcp/keys.rs",
                "package-router/src/tcp/serve.rs",
                "package-router/src/tcp/serve",
            ];
            if shell.iter().any(|path| file.starts_with(root.join(path))) {
                continue;
            }
            looked_at += 1;
            let text = std::fs::read_to_string(&file).expect("a source file");
            let code = text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"));
            for (i, line) in code {
                let found = IMPURE.iter().find(|impure| line.contains(**impure));
                assert_eq!(found, None, "{}:{}", file.display(), i + 1);
            }
        }
    }
    assert!(looked_at > 10, "only {looked_at} files were looked at");
}

#[test]
fn every_test_that_the_specification_cites_exists() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace");
    let documents = ["SPECIFICATION.md", "docs/rtnet-rows.md"];
    let text = documents.map(|name| std::fs::read_to_string(root.join(name)).expect(name)).concat();
    let packages = metadata();
    let folders =
        packages.workspace_packages().into_iter().filter_map(|package| package.manifest_path.parent());
    let files: BTreeSet<_> = folders.flat_map(|folder| rust_files(folder.as_std_path())).collect();
    let sources: Vec<String> =
        files.iter().map(|file| std::fs::read_to_string(file).expect("a source file")).collect();
    let cited = cited_tests(&text);
    assert!(cited.len() > 80, "only {} tests are cited", cited.len());
    // Every scenario of this directory is a test by the name of its file.
    let is_scenario = |name: &str| root.join(format!("tests/sim/{name}.toml")).exists();
    let is_there = |name: &&&str| {
        is_scenario(name) || sources.iter().any(|source| source.contains(&format!("fn {name}(")))
    };
    let missing: Vec<_> = cited.iter().filter(|name| !is_there(name)).collect();
    assert!(missing.is_empty(), "tests that are cited and do not exist: {missing:?}");
}

/// The rows of a document's tables, or of one section's, cell by cell.
fn rows(document: &str, section: &str) -> Vec<Vec<String>> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace");
    let text = std::fs::read_to_string(root.join(document)).expect(document);
    let from = text.find(section).expect("the section");
    let lines = text[from..]
        .lines()
        .enumerate()
        .take_while(|(i, line)| *i == 0 || section.is_empty() || !line.starts_with("## "));
    let cells = |line: &str| line.trim_matches('|').split(" |").map(|cell| cell.trim().to_owned()).collect();
    let is_head =
        |row: &Vec<String>| matches!(row[0].as_str(), "row" | "of" | "#") || row[0].starts_with("--");
    let rows = lines.filter(|(_, line)| line.starts_with('|')).map(|(_, line)| cells(line));
    rows.filter(|row| !is_head(row)).collect()
}

#[test]
fn every_statement_of_the_reference_has_a_test_or_a_reason() {
    // What is of a part that is not there yet, or cannot be seen from outside, or says where it is treated.
    let needs_none = |here: &str| ["later", "theirs", "see "].iter().any(|begin| here.starts_with(begin));
    let kept = rows("docs/rtnet-rows.md", "");
    for row in &kept {
        let [there, here, shown] = &row[..] else { panic!("not three cells: {row:?}") };
        assert!(!there.is_empty() && !here.is_empty(), "{row:?}");
        assert!(shown.contains('`') || needs_none(here), "neither a test nor a reason: {row:?}");
    }
    let different = rows("SPECIFICATION.md", "## Deliberately different");
    for row in &different {
        let [of, there, here, because, shown] = &row[..] else { panic!("not five cells: {row:?}") };
        assert!([of, there, here, because].iter().all(|cell| !cell.is_empty()), "no reason: {row:?}");
        assert!(shown.contains('`'), "no test: {row:?}");
    }
    assert!(kept.len() > 80 && different.len() > 45, "{} and {} rows", kept.len(), different.len());
}

#[test]
fn every_complaint_of_rtnets_users_has_a_line_and_what_is_solved_names_who_shows_it() {
    let all = rows("SPECIFICATION.md", "What RTnet's users complained of (section 12");
    let numbers: Vec<_> = all.iter().map(|row| row[0].parse::<u32>().ok()).collect();
    assert_eq!(numbers, (1..=18).map(Some).collect::<Vec<_>>());
    for row in &all {
        let [_, complaint, here] = &row[..] else { panic!("not three cells: {row:?}") };
        assert!(!complaint.is_empty() && !here.is_empty(), "{row:?}");
        // A test that it names exists: see above.
        let names = |word: &str| word.contains('_') || word.starts_with("rtnet ");
        let shown = here.split('`').skip(1).step_by(2).any(names);
        assert!(shown || !here.starts_with("solved"), "neither a test nor a command: {row:?}");
    }
}

#[test]
fn cited_tests_stand_in_the_last_column() {
    let table =
        "`not_in_a_table`\n\n| `a_b` is | `c.rs`: `d_e`, `..._f` (`g_h = 1`, `x::i_j`) |\n|---|---|\n";
    assert_eq!(cited_tests(table), BTreeSet::from(["..._f", "d_e"]));
}

/// Whatever looks like a test's name in the last columns of the tables.
fn cited_tests(text: &str) -> BTreeSet<&str> {
    let rows = text.lines().filter_map(|line| line.strip_prefix('|')?.trim_end().strip_suffix('|'));
    let shown_by = rows.filter_map(|row| row.rsplit('|').next());
    // Every second piece stands between backticks.
    let quoted = shown_by.flat_map(|cell| cell.split('`').skip(1).step_by(2));
    let word = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_' || c == '.';
    quoted.filter(|name| name.contains('_') && !name.ends_with(".rs") && name.chars().all(word)).collect()
}

fn rust_files(folder: &Path) -> Vec<std::path::PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let paths = entries.map(|entry| entry.expect("a directory entry").path());
    let (folders, files): (Vec<_>, Vec<_>) = paths.partition(|path| path.is_dir());
    let inner = folders.iter().flat_map(|folder| rust_files(folder));
    let rust = |path: &std::path::PathBuf| path.extension().is_some_and(|extension| extension == "rs");
    files.into_iter().filter(rust).chain(inner).collect()
}

/// An SPDX expression of OR, AND and brackets around licences on the list; OR may be a slash.
fn is_permissive(licence: &str) -> bool {
    let spaced = licence.replace('(', " ( ").replace(')', " ) ").replace('/', " OR ");
    let tokens: Vec<&str> = spaced.split_whitespace().collect();
    let mut rest = &tokens[..];
    let value = either(&mut rest);
    value && rest.is_empty()
}

fn either(rest: &mut &[&str]) -> bool {
    let mut value = both(rest);
    while let [first, tail @ ..] = *rest
        && *first == "OR"
    {
        *rest = tail;
        value |= both(rest);
    }
    value
}

fn both(rest: &mut &[&str]) -> bool {
    let mut value = one(rest);
    while let [first, tail @ ..] = *rest
        && *first == "AND"
    {
        *rest = tail;
        value &= one(rest);
    }
    value
}

fn one(rest: &mut &[&str]) -> bool {
    match **rest {
        ["(", ref tail @ ..] => {
            *rest = tail;
            let value = either(rest);
            *rest = rest.strip_prefix(&[")"]).unwrap_or(&[]);
            value
        }
        [licence, "WITH", exception, ref tail @ ..] => {
            *rest = tail;
            PERMISSIVE.contains(&format!("{licence} WITH {exception}").as_str())
        }
        [licence, ref tail @ ..] => {
            *rest = tail;
            PERMISSIVE.contains(&licence)
        }
        [] => false,
    }
}
