use std::collections::BTreeSet;

use super::*;
use crate::scenario::Source;
use crate::sim::{self, Ended, Options};

/// Three stations of which one misses turns and one is held up in its send beyond them.
const NETWORK: &str = r#"
cycle = "1ms"
rate = "100M"
guard = "60us"
slot_guard = "user"
duration = "500ms"
[[station]]
name = "master"
role = "master"
slots = [{ id = 0, offset = "100us" }]
[[station]]
name = "arm"
role = "slave"
host = { outages = { ppm = 3000, longest = "300us" } }
slots = [{ id = 0, offset = "300us" }, { id = 2, offset = "700us", phase = "2/2" }]
[[station]]
name = "camera"
role = "slave"
slots = [{ id = 0, offset = "500us" }]
[[event]]
at = "200ms"
stall = "camera"
for = "230us"
"#;

fn page(network: &str) -> (Scenario, Kept, String) {
    let mut scenario = Source::new("net.toml", network).parse().unwrap();
    // No file has such a name: a page is right whatever it shows.
    scenario.stations[1].name = "arm <b> & 'co\"'".into();
    let options = Options { pictures: true, ..Options::default() };
    let Ended { figures, kept, .. } = sim::run(&scenario, &options).unwrap();
    let (title, simulation) = ("a<b>.toml", Some(&figures.simulation));
    let page =
        Sheet { title, scenario: &scenario, figures: &figures.figures, kept: &kept, simulation }.page();
    (scenario, kept, page)
}

#[test]
fn one_seed_is_one_page_to_the_byte() {
    let [(.., first), (.., second)] = [page(NETWORK), page(NETWORK)];
    assert!(first == second && first.len() > 20_000, "{} {}", first.len(), second.len());
}

#[test]
fn a_page_needs_nothing_else_and_no_name_is_markup() {
    let (.., page) = page(NETWORK);
    for never in ["http", "src=", "url(", "<script", "@import", "<link", "<b> & 'co", "a<b>"] {
        assert!(!page.contains(never), "{never}");
    }
    assert!(page.contains("arm &lt;b&gt; &amp; &#39;co&quot;&#39;") && page.contains("a&lt;b&gt;.toml"));
    for id in ["latency", "cycles", "sync", "stations", "jitter", "causes", "indicators", "host"] {
        assert!(page.contains(&format!("<section id=\"{id}\">")), "{id}");
    }
}

/// Of each picture of a cycle: its number, and by station and id where its slots are, in thousandths of a per cent.
fn pictures(page: &str) -> Vec<(u32, BTreeSet<(String, i64)>)> {
    let number = |text: &str| (text.split_once('%').unwrap().0.parse::<f64>().unwrap() * 1e3).round() as i64;
    let after = |text: &str, what: &str| text.split_once(what).map(|(_, rest)| rest.to_owned());
    let slot = |piece: &str| {
        let name = piece.split_once('"').unwrap().0.to_owned();
        (name, number(&after(piece, " x=\"").unwrap()))
    };
    let figures = page.split("<figure ").skip(1).map(|figure| figure.split_once("</figure>").unwrap().0);
    let picture = |figure: &str| {
        let cycle = after(figure, "slots and frames of cycle ").unwrap();
        let cycle = cycle.split_once('"').unwrap().0.parse().unwrap();
        (cycle, figure.split("data-slot=\"").skip(1).map(slot).collect())
    };
    figures.map(picture).collect()
}

#[test]
fn every_picture_has_the_slots_of_the_file_that_have_their_turn_where_the_file_has_them() {
    let (scenario, kept, page) = page(NETWORK);
    let pictures = pictures(&page);
    assert_eq!(pictures.len(), kept.cycles.worst.len() + 1, "the worst, and an ordinary one");
    assert!(pictures.len() > 3);
    for (cycle, slots) in pictures {
        let mut of_file = BTreeSet::new();
        for station in &scenario.stations {
            for slot in station.slots.iter().filter(|slot| cycle % slot.period == slot.phase) {
                let at = slot.offset.nanos() * 100_000 / scenario.cycle.nanos();
                of_file.insert((format!("{} {}", escape(&station.name), slot.id), at));
            }
        }
        assert_eq!(slots, of_file, "cycle {cycle}");
    }
}

#[test]
fn what_is_late_or_missing_is_said_in_words_too() {
    let (_, kept, page) = page(NETWORK);
    let (first, _) = page.split_once("</figure>").unwrap();
    assert!(first.contains("camera, slot 0, is outside, +2"), "the frame that was held up comes first");
    assert!(first.contains(": held up in send, ") && first.contains("class=\"frame late\""));
    assert!(first.contains("class=\"why\"") && first.contains(">+2"), "its lateness is beside it");
    assert!(page.contains("has no frame: skipped, ") && page.contains("class=\"slot missing\""));
    assert!(kept.cycles.faulty >= 3 && kept.cycles.ordinary.is_some());
    let ordinary = page.rsplit("<figure ").next().unwrap();
    assert!(ordinary.starts_with("class=\"cycle\"") && !ordinary.contains("class=\"why\""));
}

#[test]
fn indicators_say_of_how_many_or_why_not() {
    let (.., page) = page(NETWORK);
    let section = page.split_once("<section id=\"indicators\">").unwrap().1;
    let rows: Vec<&str> = section.split("<tr>").skip(2).take(10).collect();
    assert_eq!(rows.len(), 10);
    assert!(rows[0].contains("Delivery time, max, no frame lost") && rows[0].contains("µs"), "{}", rows[0]);
    assert!(rows[9].contains("not measured") && rows[9].contains("no station is a backup"), "{}", rows[9]);
    assert!(rows[6].contains("0 %") && rows[6].contains("No station has a VNIC"), "{}", rows[6]);
}

#[test]
fn a_run_without_a_fault_says_so_and_shows_one_cycle() {
    let network = "cycle = \"1ms\"\nduration = \"100ms\"\n[[station]]\nname = \"master\"\nrole = \"master\"\n\
                   [[station]]\nname = \"arm\"\nrole = \"slave\"\n";
    let (.., page) = page(network);
    assert!(page.contains("In no cycle was a frame late") && page.contains("<strong>OK</strong>"));
    assert_eq!(pictures(&page).len(), 1);
}
