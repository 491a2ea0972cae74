use super::*;
use crate::scenario::Source;

/// Stations with a slot of their own each, evenly in 10 ms, and the slots of `more`.
fn plan(stations: usize, more: &str) -> Plan {
    let station = |n: usize| {
        let role = if n == 0 { "master" } else { "slave" };
        let offset = 1_000 + 8_000 * n / stations;
        format!(
            "[[station]]\nname = \"axis{n}\"\nrole = \"{role}\"\nslots = [{{ id = 0, offset = \"{offset}us\" }}{}]\n",
            if n == 0 { more } else { "" }
        )
    };
    let text = format!("cycle = \"10ms\"\n{}", (0..stations).map(station).collect::<String>());
    Plan::of(&Source::new("net.toml", &text).parse().unwrap(), None)
}

#[test]
fn every_slot_of_a_plan_has_a_label() {
    for stations in [2, 8, 60, 250] {
        let svg = draw(&plan(stations, ""));
        for n in 0..stations {
            assert!(svg.contains(&format!(">axis{n} 0</text>")), "{n} of {stations}");
        }
    }
    let in_turn = draw(&plan(
        2,
        ", { id = 2, offset = \"9200us\", phase = \"1/2\" }, { id = 3, offset = \"9500us\", phase = \"2/2\" }",
    ));
    for (label, times) in [("0", 2), ("2", 1), ("3", 1)] {
        let label = format!(">axis0 {label}</text>");
        assert_eq!(in_turn.matches(&label).count(), times, "{label}");
    }
    let text = "cycle = \"5ms\"\n[[station]]\nname = \"the_arm_at_the_left_of_the_line\"\nrole = \"master\"\nslots = [\n\
                { id = 0, offset = \"300us\" }, { id = 2, offset = \"900us\" } ]\n\
                [[station]]\nname = \"leg\"\nrole = \"slave\"\nslots = [{ id = 0, offset = \"2ms\" }]\n";
    let svg = draw(&Plan::of(&Source::new("net.toml", text).parse().unwrap(), None));
    for slot in ["0", "2"] {
        assert!(svg.contains(&format!(">the_arm_at_the_... {slot}</text>")), "{slot}: {svg}");
    }
}

#[test]
fn every_part_of_a_picture_stands_in_its_legend() {
    let backup = "name = \"b\"\nrole = \"backup\"\nbackup = \"600us\"";
    let text =
        format!("cycle = \"5ms\"\n[[station]]\nname = \"m\"\nrole = \"master\"\n[[station]]\n{backup}\n");
    let with_backup = Plan::of(&Source::new("net.toml", &text).parse().unwrap(), None);
    for (plan, has_backup) in [(plan(2, ""), false), (with_backup, true)] {
        let svg = draw(&plan);
        for what in ["window of the sync", "the guard band behind it", "in its station's colour", "free"] {
            assert!(svg.contains(what), "{what}");
        }
        assert_eq!(svg.contains("a backup's sync, if it takes over"), has_backup);
        for line in svg.lines().filter(|line| line.starts_with("<text x") && line.contains("small")) {
            let field =
                |before: &str, behind: char| line.split(before).nth(1).unwrap().split(behind).next().unwrap();
            let (x, text): (f64, _) = (field("x=\"", '"').parse().unwrap(), field("\">", '<'));
            assert!(x + labels::width(text) <= WIDTH + RIGHT, "{line}");
        }
    }
}

#[test]
fn many_slots_make_a_picture_wider_not_fuller() {
    let width = |stations: usize| Picture::of(&plan(stations, "")).width;
    assert_eq!((width(8), width(60)), (WIDTH, WIDTH));
    assert_eq!(width(250), LEFT + RIGHT + Labels::room_for(250));
}
