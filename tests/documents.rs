//! The documents stay short, complete and free of dead links.

use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace").to_owned()
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The pages below `directory`, without those in folders of their own.
fn pages(directory: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(root().join(directory)).expect(directory);
    let files = entries.map(|entry| entry.unwrap().path());
    let mut pages: Vec<_> = files.filter(|path| path.extension().is_some_and(|of| of == "md")).collect();
    pages.sort();
    pages
}

/// The targets of a page's links that are files.
fn links(text: &str) -> Vec<&str> {
    let targets = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    let files = targets.filter(|target| !target.contains("://") && !target.starts_with('#'));
    files.map(|target| target.split('#').next().expect("a first part")).collect()
}

#[test]
fn readme_has_at_most_160_lines() {
    let lines = read(&root().join("README.md")).lines().count();
    assert!(lines <= 160, "README.md has {lines} lines: move details into docs/book");
}

#[test]
fn readme_has_a_drawing_a_legend_and_a_licence() {
    let readme = read(&root().join("README.md"));
    let (what_it_is, rest) = readme.split_once("\n## Try it\n").expect("how to try it");
    assert!(what_it_is.contains("slot of A") && what_it_is.contains("sync: "), "a drawing of a cycle");
    let (tried, rest) = rest.split_once("\n## Install\n").expect("how to install it");
    for command in ["```\ncargo run --release -- lab run\n```", "```\ncargo test --workspace\n```"] {
        assert!(tried.contains(command), "{command}");
    }
    let (report, legend) = tried.split_once("| column or line | meaning |").expect("a legend");
    assert!(report.lines().any(|line| line.starts_with("OK: ")), "a report with its verdict");
    for word in ["miss", "slot error", "sync p99", "overlaps, out of slot", "unexplained", "last line"] {
        assert!(legend.contains(&format!("\n| {word} |")), "the legend has no '{word}'");
    }
    for part in [
        "\n## Nothing else does this\n",
        "\n## It is not\n",
        "\n## Chapters\n",
        "\nLicensed under MIT or Apache-2.0",
    ] {
        assert!(rest.contains(part), "{part}");
    }
}

#[test]
fn files_that_documents_name_exist() {
    let mut checked = 0;
    for page in [".", "docs", "docs/book"].into_iter().flat_map(pages) {
        for name in read(&page).split('`').skip(1).step_by(2) {
            let is_file =
                ["tests/", "tools/", "rtnet/", "rtmac/", "vnic/", "package-router/", "scripts/", "docs/"]
                    .iter()
                    .any(|folder| name.starts_with(folder));
            // A name in capitals, or with a star, stands for several files.
            if is_file && !name.contains([' ', '*', '{']) && !name.contains("KIND") {
                assert!(root().join(name).exists(), "{} names {name}, which does not exist", page.display());
                checked += 1;
            }
        }
    }
    assert!(checked >= 50, "only {checked} files are named");
}

#[test]
fn links_of_all_documents_lead_to_files() {
    let all: Vec<_> = [".", "docs", "docs/book"].into_iter().flat_map(pages).collect();
    let mut checked = 0;
    for page in &all {
        let text = read(page);
        for link in links(&text) {
            let target = page.parent().expect("a folder").join(link);
            assert!(target.exists(), "{} links to {link}, which does not exist", page.display());
            checked += 1;
        }
    }
    assert!(checked >= 20, "only {checked} links were found in {} pages", all.len());
}

#[test]
fn readme_links_to_every_chapter_of_the_book() {
    let readme = read(&root().join("README.md"));
    let linked = links(&readme);
    for page in pages("docs/book") {
        let name = page.file_name().expect("a name").to_string_lossy().into_owned();
        let link = format!("docs/book/{name}");
        assert!(linked.contains(&link.as_str()), "README.md does not link to {link}");
    }
}

/// The README's own text: without code, tables' separators and links' targets.
fn sentences(text: &str) -> Vec<String> {
    let prose = text.split("```").step_by(2).collect::<Vec<_>>().join("\n");
    let flat = prose.replace(['|', '*'], ".").replace('\n', " ");
    flat.split(['.', ':', ';']).map(|sentence| sentence.trim().to_owned()).collect()
}

#[test]
fn readme_sentences_begin_with_a_subject() {
    let readme = read(&root().join("README.md"));
    let begins_badly = |sentence: &&String| {
        ["Who ", "What ", "Of ", "So many "].iter().any(|begin| sentence.starts_with(begin))
    };
    let bad: Vec<_> = sentences(&readme).into_iter().filter(|sentence| begins_badly(&sentence)).collect();
    assert!(bad.is_empty(), "{bad:#?}");
}
