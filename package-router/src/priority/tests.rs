use super::*;
use proptest::prelude::*;

fn parsed(text: &str) -> Priorities {
    Priorities::parse(text, "priorities.toml").unwrap()
}

fn refused(text: &str) -> String {
    Priorities::parse(text, "priorities.toml").unwrap_err().to_string()
}

#[test]
fn without_a_file_the_highest_4_bits_of_the_class_are_the_level() {
    let rule = Priorities::default();
    for class in (0..=255).map(Class) {
        assert_eq!(rule.level(class).level(), class.0 >> 4, "{class}");
        assert_eq!(rule.package(class), of_class(class));
        assert_eq!((rule.task(class), rule.channel(class)), (None, 0));
    }
    for (class, package) in [(Class::SYSTEM, 255), (Class::PILOT, 247), (Class::MCL, 239), (Class(0xff), 135)]
    {
        assert_eq!(rule.package(class), package, "{class}");
    }
    assert_eq!(parsed(""), rule);
    assert_eq!(parsed("[class]"), rule);
}

#[test]
fn every_priority_leads_to_a_level_for_packages_and_the_more_urgent_never_to_a_later() {
    for (priority, level) in
        [(255, 0), (248, 0), (247, 1), (231, 3), (16, 29), (15, 30), (8, 30), (7, 30), (0, 30)]
    {
        assert_eq!(level_of(priority).level(), level, "{priority}");
    }
    assert!((0..=255).map(level_of).is_sorted_by(|less, more| less >= more));
    assert!((0..=255).all(|priority| level_of(priority) <= Priority::LAST_REAL_TIME));
}

#[test]
fn a_level_and_the_priority_that_leads_to_it_are_one_thing_in_both_directions() {
    for level in (0..31).map(|level| Priority::new(level).unwrap()) {
        assert_eq!(level_of(priority_of_level(level)), level);
        let more_urgent = priority_of_level(level).checked_add(1);
        assert!(
            more_urgent.is_none_or(|priority| level_of(priority) < level),
            "the most urgent of its level"
        );
    }
    assert_eq!(priority_of_level(Priority::NON_RT), priority_of_level(Priority::LAST_REAL_TIME));
}

#[test]
fn a_class_is_what_the_file_says_by_its_name_or_number() {
    let priorities = parsed(
        "[class.pilot]\ntask = 99\npackage = 0\nchannel = 255\n[class.0x80]\nlevel = 30\n[class.129]\nlevel = 0\n[class.GUI]\ntask = 1",
    );
    let said = |class| (priorities.task(class), priorities.package(class), priorities.channel(class));
    assert_eq!(said(Class::PILOT), (Some(99), 0, 255));
    assert_eq!(said(Class(0x80)), (None, 15, 0));
    assert_eq!(said(Class(0x81)), (None, 255, 0));
    assert_eq!(said(Class::GUI), (Some(1), 255, 0), "of its packages the rule holds");
    assert_eq!(priorities.level(Class(0x80)), Priority::LAST_REAL_TIME);
    let named = [Class::PILOT, Class(0x80), Class(0x81), Class::GUI];
    let others = (0..=255).map(Class).filter(|class| !named.contains(class));
    for class in others {
        assert_eq!(said(class), (None, of_class(class), 0), "{class}");
    }
}

#[test]
fn an_unknown_class_is_named_with_its_line_and_with_those_there_are() {
    let error = refused("[class.Gyro]\ntask = 3\n\n[class.Pilt]\ntask = 5\n");
    assert!(
        error.starts_with(
            "priorities.toml:4:8: 'Pilt' is no class: no class is called 'Pilt': there are System"
        )
    );
    assert!(error.ends_with("and all have numbers, as 0x80"), "{error}");
    assert_eq!(
        refused("[class.0x100]"),
        "priorities.toml:1:8: '0x100' is no class: its class is to be 0 to 255, or 0x00 to 0xff, and is '0x100'"
    );
}

#[test]
fn every_number_out_of_its_range_is_named_with_its_line_and_range() {
    let of_pilot = |line: &str| refused(&format!("[class.Pilot]\n{line}\n"));
    for (what, numbers, says) in [
        ("task", [-1, 0, 100], "SCHED_FIFO priority of tasks: 1 to 99"),
        ("package", [-1, 256, i64::MAX], "priority of packages (larger is more urgent): 0 to 255"),
        ("level", [-1, 31, 256], "transmit level of packages (0 is the most urgent): 0 to 30"),
        ("channel", [-1, 256, i64::MIN], "channel, which is the id of a slot: 0 to 255"),
    ] {
        for number in numbers {
            let column = what.len() + 4;
            let expected = format!("priorities.toml:2:{column}: {number} is no {says}");
            assert_eq!(of_pilot(&format!("{what} = {number}")), expected);
        }
    }
    assert!(
        of_pilot("task = 'high'")
            .starts_with("priorities.toml:2:8: invalid type: string \"high\", expected i64")
    );
}

#[test]
fn package_and_level_of_one_class_are_refused_and_of_two_are_not() {
    let error = refused("[class.Pilot]\nlevel = 3\ntask = 7\npackage = 231\n");
    assert_eq!(
        error,
        "priorities.toml:4:11: package and level of one class: the level follows from the priority of packages; leave one of \
         them out"
    );
    parsed("[class.Pilot]\nlevel = 3\n[class.Gyro]\npackage = 231\n");
}

#[test]
fn a_class_that_stands_twice_by_name_and_number_is_refused_where_it_stands_again() {
    for (first, again) in [("Pilot", "0x18"), ("0x18", "pilot"), ("24", "PILOT"), ("0x18", "0X18")] {
        let error = refused(&format!("[class.{first}]\ntask = 7\n[class.{again}]\ntask = 7\n"));
        assert_eq!(error, "priorities.toml:3:8: Pilot stands in line 1 already: name a class once");
    }
    let error = refused("[class.Pilot]\n[class.Pilot]\n");
    assert!(error.starts_with("priorities.toml:2:"), "{error}");
}

#[test]
fn what_the_file_may_not_say_is_named_with_what_it_may() {
    for (text, says) in [
        (
            "[class.Pilot]\nprio = 3",
            "2:1: unknown field `prio`, expected one of `task`, `package`, `level`, `channel`",
        ),
        ("\n[classes.Pilot]\ntask = 3", "2:2: unknown field `classes`, expected `class`"),
        ("[[class.Pilot]]\ntask = 3", "1:9: what is said of a class stands below [class.Pilot], once"),
        ("class.Pilot = 70", "1:7: what is said of a class stands below [class.Pilot], once"),
        ("class.Pilot = [70, 231]", "1:7: what is said of a class stands below [class.Pilot], once"),
        ("class = 70", "1:9: invalid type: integer `70`, expected a map"),
        ("[class.Pilot\ntask = 3", "1:13: unclosed table, expected `]`"),
    ] {
        assert_eq!(refused(text), format!("priorities.toml:{says}"), "{text}");
    }
}

proptest! {
    #[test]
    fn what_is_said_of_one_class_is_found_and_changes_no_other(
        class in any::<u8>().prop_map(Class),
        (task, package, channel) in (1u8..=99, any::<u8>(), any::<u8>()),
        other in any::<u8>().prop_map(Class),
    ) {
        let text = format!("[class.{class}]\ntask = {task}\npackage = {package}\nchannel = {channel}\n");
        let priorities = parsed(&text);
        let found = (priorities.task(class), priorities.package(class), priorities.channel(class));
        prop_assert_eq!(found, (Some(task), package, channel));
        prop_assert_eq!(priorities.level(class), level_of(package));
        if other != class {
            prop_assert_eq!(priorities.package(other), of_class(other));
        }
    }
}
