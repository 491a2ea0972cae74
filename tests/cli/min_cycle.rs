//! `rtnet find-min-cycle` from the outside: a search among three cycles, kept, and compared with.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Duration;

use rtnet::live::realtime::allowed_cpus;
use serde_json::Value;

use crate::host::{alone, network};
use crate::lab::stations_of;
use crate::{rtnet, schema};

/// The guard bands leave no room for cycles below 910us, and any share may be missed: whatever the host, that is the answer.
const LOOSE: [&str; 6] = ["--stations", "2", "--guard", "400us", "--miss", "100%"];
/// Three cycles are left, or one.
const LONGEST: [&str; 2] = ["--longest", "1.1ms"];
const ONE: [&str; 2] = ["--longest", "950us"];
/// Lengths of a trial and of a proof.
const SHORT: [&str; 4] = ["--trial", "300ms", "--proof", "500ms"];

/// Exit status, and all that is printed.
fn searched(options: &[&str], files: &[(&str, &Path)]) -> (Option<i32>, String) {
    let mut search = rtnet();
    search.arg("find-min-cycle").args(options);
    files.iter().for_each(|(option, file)| {
        search.arg(option).arg(file);
    });
    let output = search.output().unwrap();
    (output.status.code(), [output.stdout, output.stderr].map(|of| String::from_utf8(of).unwrap()).concat())
}

/// The runs that were not repeated.
fn decided(answer: &Value) -> Vec<&Value> {
    answer["runs"].as_array().unwrap().iter().filter(|run| !run["holds"].is_null()).collect()
}

#[test]
fn the_shortest_cycle_is_found_proven_and_kept_and_a_longer_one_is_a_regression() {
    network("the_shortest_cycle_is_found_proven_and_kept_and_a_longer_one_is_a_regression", || {
        let dir = tempfile::tempdir().unwrap();
        let [kept, again] = ["kept.json", "again.json"].map(|name| dir.path().join(name));
        let loose = [&LOOSE[..], &SHORT, &LONGEST].concat();
        let (status, said) = searched(&loose, &[("--json", &kept)]);
        assert_eq!(status, Some(0), "{said}");
        assert!(
            said.contains("FOUND: 910us is the shortest cycle that this host holds, proven for 500ms"),
            "{said}"
        );
        assert!(said.contains("rtnet: 910us is proven"), "{said}");
        let mut answer: Value = schema::read(fs::read(&kept).unwrap());
        assert_eq!(answer["cycle_ns"], 910_000);
        let runs = decided(&answer);
        let of =
            |run: &&Value| (run["cycle_ns"].as_i64().unwrap(), run["purpose"].as_str().unwrap().to_owned());
        let trials = [1_000_000, 910_000].map(|cycle| (cycle, "trial".to_owned()));
        assert_eq!(
            runs.iter().map(of).collect::<Vec<_>>(),
            [&trials[..], &[(910_000, "proof".to_owned())]].concat()
        );
        let slots = runs[2]["slots"].as_u64().unwrap();
        assert!((1_000..=2 * 549).contains(&slots), "of 500ms: {slots}");

        answer["cycle_ns"] = 700_000.into();
        fs::write(&kept, answer.to_string()).unwrap();
        let files = [("--compare", kept.as_path()), ("--json", again.as_path())];
        let (status, said) = searched(&ONE, &files);
        assert_eq!(status, Some(1), "{said}");
        assert!(said.contains("REGRESSION: 910us now, 700us in "), "{said}");
        let answer = schema::read(fs::read(&again).unwrap());
        let runs = decided(&answer);
        let lengths = runs.iter().map(|run| run["duration_ns"].as_i64().unwrap());
        assert_eq!(lengths.collect::<Vec<_>>(), [300_000_000, 500_000_000], "as in the kept file");
        let (status, said) = searched(&ONE, &[("--compare", &again)]);
        assert_eq!(status, Some(0), "{said}");
        assert!(said.contains("AS GOOD: 910us now, 910us in "), "{said}");
        for other in [["--stations", "3"], ["--trial", "301ms"], ["--proof", "5s"]] {
            let (status, said) = searched(&other, &[("--compare", &again)]);
            assert_eq!(status, Some(2), "{said}");
            assert!(said.contains("--compare is the answer to another question"), "{said}");
        }
    });
}

#[test]
fn where_no_cycle_is_held_that_is_the_answer_and_so_it_is_kept() {
    network("where_no_cycle_is_held_that_is_the_answer_and_so_it_is_kept", || {
        let dir = tempfile::tempdir().unwrap();
        let kept = dir.path().join("none.json");
        // Nine turns on one core take 18 us each, at the least.
        let none = [&["--stations", "8", "--miss", "0%", "--longest", "51us"][..], &SHORT].concat();
        let (status, said) = searched(&none, &[("--json", &kept)]);
        assert_eq!(status, Some(1), "{said}");
        assert!(
            said.contains("NOT FOUND: no cycle that was tried misses at most 0 % of its slots"),
            "{said}"
        );
        let answer: Value = schema::read(fs::read(&kept).unwrap());
        assert_eq!((&answer["cycle_ns"], &answer["runs"][0]["holds"]), (&Value::Null, &false.into()));
    });
}

#[test]
fn a_search_runs_all_its_labs_on_one_core() {
    alone("a_search_runs_all_its_labs_on_one_core", || {
        let cpus = allowed_cpus();
        let (first, last) = (cpus[0].to_string(), cpus[cpus.len() - 1].to_string());
        for (asked, core) in [(Some(&first), &first), (None, &last)] {
            let mut search = rtnet();
            search.arg("find-min-cycle").args(LOOSE).args(SHORT).args(ONE);
            asked.iter().for_each(|core| {
                search.args(["--cpu", core]);
            });
            let mut search = search.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
            let seen = stations_while_it_runs(&mut search);
            // A trial and a proof, of two stations each.
            assert!(seen.len() >= 4, "--cpu {asked:?}: {seen:?}");
            assert!(seen.iter().all(|(_, on)| on == core), "--cpu {asked:?}: {seen:?}");
        }
    });
}

/// Each station that a search starts: its process, and the core that its command line names.
fn stations_while_it_runs(search: &mut Child) -> BTreeSet<(i32, String)> {
    let mut seen = BTreeSet::new();
    while search.try_wait().unwrap().is_none() {
        for pid in stations_of(search.id()) {
            let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let mut words = line.split('\0').skip_while(|word| *word != "--cpu");
            // Before it is the station's own, the line is that of its parent, which may name no core.
            if line.contains("\0station\0")
                && let Some(core) = words.nth(1)
            {
                seen.insert((pid, core.to_owned()));
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    seen
}
