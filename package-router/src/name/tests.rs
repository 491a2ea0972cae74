use super::*;
use proptest::prelude::*;

fn refused<T: FromStr<Err = NameError> + fmt::Debug>(text: &str) -> String {
    text.parse::<T>().unwrap_err().to_string()
}

fn pattern(text: &str) -> Pattern {
    text.parse().unwrap()
}

#[test]
fn a_name_is_four_places_in_one_number() {
    let name = MailboxName::new(1, Class::PILOT, 2, 3);
    assert_eq!(name, MailboxName(0x0118_0203));
    assert_eq!((name.system(), name.class(), name.instance(), name.local()), (1, Class(0x18), 2, 3));
    assert_eq!(name.with_local(0), MailboxName::new(1, Class::PILOT, 2, 0));
    assert_eq!(MailboxName::NOBODY, MailboxName::new(0, Class::SYSTEM, 0, 0));
    assert_eq!(MailboxName(u32::MAX).with_local(1), MailboxName(0xffff_ff01));
}

#[test]
fn names_are_shown_by_their_class() {
    for (name, shown) in [
        (MailboxName::new(0, Class::ODOMETRY, 1, 0), "Odometry(0/1)"),
        (MailboxName::new(0, Class::ODOMETRY, 1, 3), "Odometry(0/1).3"),
        (MailboxName::new(7, Class(0x80), 255, 0), "0x80(7/255)"),
        (MailboxName::new(0, Class(0x03), 0, 1), "0x03(0/0).1"),
        (MailboxName::NOBODY, "System(0/0)"),
        (MailboxName(0x0001_0000), "GDOS(0/0)"),
    ] {
        assert_eq!((name.to_string(), format!("{name:?}")), (shown.to_owned(), shown.to_owned()));
        assert_eq!(shown.parse(), Ok(name));
    }
}

#[test]
fn a_name_may_be_written_in_words_or_numbers() {
    let name = MailboxName::new(0, Class::ODOMETRY, 1, 0);
    for text in [
        "0.Odometry.1",
        "0.oDOMETRY.1.0",
        "0.18.1",
        "0.0x12.0x01.0x0",
        "0x00120100",
        "0X120100",
        "odometry(0/1)",
        "0x12(0/1)",
        "18(0x0/0X1).0",
    ] {
        assert_eq!(text.parse(), Ok(name), "{text}");
    }
    assert_eq!("0x120103".parse(), Ok(name.with_local(3)));
    assert_eq!("255.255.255.255".parse(), Ok(MailboxName(u32::MAX)));
}

#[test]
fn all_classes_have_the_numbers_that_peers_know_them_by() {
    let known: Vec<u8> = (0x00..=0x02).chain(0x10..=0x28).collect();
    assert_eq!(Class::NAMED.iter().map(|(class, _)| class.0).collect::<Vec<_>>(), known);
    for &(class, name) in Class::NAMED {
        assert_eq!((class.to_string(), class.name()), (name.to_owned(), Some(name)));
        assert_eq!(name.to_uppercase().parse(), Ok(class));
    }
    for (class, name) in
        [(0x17, "Joystick"), (0x1b, "ObjRecog"), (0x1f, "Io"), (0x20, "ServoDrive"), (0x28, "Compass")]
    {
        assert_eq!(Class(class).name(), Some(name));
    }
    assert_eq!("0x80".parse(), Ok(Class(0x80)));
    assert_eq!((Class(0x80).to_string(), Class(0x80).name()), ("0x80".to_owned(), None));
}

#[test]
fn what_is_no_name_says_what_of_it_is_wrong_and_how_it_should_be() {
    for text in [
        "",
        "Odometry",
        "0.Odometry",
        "0.Odometry.1.2.3",
        "1179648",
        "0x",
        "0x123456789",
        "0x-1",
        "0x+1",
        "Odometry(0/1",
        "Odometry(0)",
        "Odometry(0/1)3",
        "Odometry 0/1",
        "0x12 ",
        "*",
        "0.",
    ] {
        let error = refused::<MailboxName>(text);
        let expected = format!(
            "'{text}' is no mailbox name: expected one as Odometry(0/1) or, of a further mailbox, Odometry(0/1).3, or \
             0.Odometry.1.3, 0.0x12.1.3 or 0x00120103"
        );
        assert_eq!(error, expected);
    }
    for (text, place, wrong) in [
        ("256.Odometry.1", "system", "256"),
        ("-1.Odometry.1", "system", "-1"),
        ("Odometry(+1/1)", "system", "+1"),
        ("0.0x100.1", "class", "0x100"),
        ("0.1a.1", "class", "1a"),
        ("0.Odometry.", "instance", ""),
        ("Odometry(0/0x)", "instance", "0x"),
        ("Odometry(0/0/1)", "instance", "0/1"),
        ("0.Odometry. 1", "instance", " 1"),
        ("0.Odometry.1.", "local", ""),
        ("Odometry(0/1).999", "local", "999"),
        ("Odometry(0/1).1.1", "local", "1.1"),
    ] {
        let expected = format!(
            "'{text}' is no mailbox name: its {place} is to be 0 to 255, or 0x00 to 0xff, and is '{wrong}'"
        );
        assert_eq!(refused::<MailboxName>(text), expected);
    }
    for (text, place) in [
        ("*.Odometry.1", "system"),
        ("0.*.1", "class"),
        ("Odometry(0/*)", "instance"),
        ("0.Odometry.1.*", "local"),
    ] {
        let error = refused::<MailboxName>(text);
        assert!(error.contains(&format!("its {place} is any, '*', as only a pattern's can be")), "{error}");
    }
}

#[test]
fn an_unknown_class_is_told_which_there_are() {
    let error = refused::<MailboxName>("0.Odomtry.1");
    assert!(error.starts_with(
        "'0.Odomtry.1' is no mailbox name: no class is called 'Odomtry': there are System, GDOS, "
    ));
    assert!(error.ends_with("PtzDrive, Compass, and all have numbers, as 0x80"), "{error}");
    assert!(refused::<Class>("Odomtry").starts_with("'Odomtry' is no class: no class is called 'Odomtry'"));
    assert_eq!(
        refused::<Class>("0x1000"),
        "'0x1000' is no class: its class is to be 0 to 255, or 0x00 to 0xff, and is '0x1000'"
    );
    assert!(refused::<Class>("*").contains("no class is called '*'"));
}

#[test]
fn a_pattern_matches_what_has_its_places_and_no_other() {
    for (text, yes, no) in [
        ("0.Pilot.*", vec!["Pilot(0/0)", "Pilot(0/255).255"], vec!["Pilot(1/0)", "Joystick(0/0)"]),
        ("0.Pilot.1", vec!["Pilot(0/1)", "Pilot(0/1).7"], vec!["Pilot(0/2)"]),
        ("Pilot(0/1)", vec!["Pilot(0/1)", "Pilot(0/1).7"], vec!["Pilot(0/2)"]),
        ("Pilot(0/1).0", vec!["Pilot(0/1)"], vec!["Pilot(0/1).7"]),
        ("*.Pilot.*.3", vec!["Pilot(0/1).3", "Pilot(9/9).3"], vec!["Pilot(0/1)", "Gyro(0/1).3"]),
        ("1.*.*", vec!["Pilot(1/1)", "0x80(1/0).3"], vec!["Pilot(0/1)"]),
        ("*(*/*)", vec!["System(0/0)", "0xff(255/255).255"], vec![]),
        ("0x00180100", vec!["Pilot(0/1)"], vec!["Pilot(0/1).1"]),
    ] {
        yes.iter()
            .for_each(|name| assert!(pattern(text).matches(name.parse().unwrap()), "{text} and {name}"));
        no.iter()
            .for_each(|name| assert!(!pattern(text).matches(name.parse().unwrap()), "{text} and {name}"));
    }
}

#[test]
fn a_pattern_without_a_local_is_of_all_mailboxes_and_a_name_of_the_first() {
    assert_eq!(pattern("0.Pilot.1"), Pattern::new(Some(0), Some(Class::PILOT), Some(1), None));
    assert_eq!(pattern("0.Pilot.1"), pattern("0.Pilot.1.*"));
    assert_eq!("0.Pilot.1".parse(), Ok(MailboxName::new(0, Class::PILOT, 1, 0)));
    let exact = Pattern::from(MailboxName::new(0, Class::PILOT, 1, 0));
    assert_eq!((exact, exact.to_string()), (pattern("Pilot(0/1).0"), "0.Pilot.1.0".to_owned()));
    assert!(exact.is_exact() && !pattern("0.Pilot.1").is_exact());
}

#[test]
fn the_more_a_pattern_says_the_more_specific_it_is_and_left_before_right() {
    let order = [
        "0.Pilot.1.3",
        "0.Pilot.1",
        "0.Pilot.*.3",
        "0.*.1.3",
        "*.Pilot.1.3",
        "0.Pilot.*",
        "0.*.1",
        "0.*.*.3",
        "*.Pilot.1",
        "*.Pilot.*.3",
        "*.*.1.3",
        "0.*.*",
        "*.Pilot.*",
        "*.*.1",
        "*.*.*.3",
        "*.*.*",
    ];
    assert!(order.map(|text| pattern(text).specificity()).is_sorted_by(|a, b| a > b));
    order.iter().for_each(|text| assert_eq!(&pattern(text).to_string(), text));
}

#[test]
fn what_is_no_pattern_says_so() {
    for text in ["", "*", "0.Pilot", "0.Pilot.*.*.*", "Pilot(*)"] {
        let error = refused::<Pattern>(text);
        assert!(
            error.starts_with(&format!("'{text}' is no pattern of mailbox names: expected one as 0.Pilot.*"))
        );
        assert!(error.ends_with("without a local it is of all mailboxes of a component"), "{error}");
    }
    assert!(refused::<Pattern>("0.Pi*.1").contains("no class is called 'Pi*'"));
    assert!(refused::<Pattern>("0.Pilot.1*").contains("its instance is to be 0 to 255"));
}

#[test]
fn files_name_mailboxes_as_people_do() {
    #[derive(Debug, PartialEq, Deserialize)]
    struct File {
        name: MailboxName,
        to: Pattern,
        class: Class,
    }
    let file =
        |name: &str| toml::from_str::<File>(&format!("name = '{name}'\nto = '0.Pilot.*'\nclass = 'gyro'"));
    let expected = File { name: MailboxName(0x0012_0103), to: pattern("0.Pilot.*"), class: Class::GYRO };
    assert_eq!(file("Odometry(0/1).3"), Ok(expected));
    let error = file("Odomtry(0/1)").unwrap_err();
    assert!(error.message().starts_with("'Odomtry(0/1)' is no mailbox name"), "{error}");
}

#[test]
fn what_is_wrong_in_a_file_is_said_in_one_legible_line() {
    let source = Source { file: "a.toml", text: "eins = 1\n'zwölf' = 12\r\n" };
    let wrong = |at, what: &str| source.wrong(at, what).to_string();
    assert_eq!(wrong(0, "this"), "a.toml:1:1: this");
    assert_eq!(wrong(15, "two\nlines\x1b[0m\n"), "a.toml:2:6: two lines [0m");
    assert_eq!(wrong(13, "within a letter"), "a.toml:2:4: within a letter");
    assert_eq!(wrong(1_000, "far behind"), "a.toml:3:1: far behind");
    assert_eq!(wrong(0, &"x".repeat(601)), format!("a.toml:1:1: {} ...", "x".repeat(600)));
    assert_eq!(source.tables().map(|tables| tables.get_ref().len()), Ok(2));
    let broken = Source { file: "b.toml", text: "\n\nclass = [\n" };
    assert_eq!(broken.tables().map_err(|error| (error.file, error.line)).err(), Some(("b.toml".into(), 3)));
}

proptest! {
    #[test]
    fn every_name_is_read_as_it_is_shown(bits in any::<u32>(), hex in any::<bool>()) {
        let name = MailboxName(bits);
        prop_assert_eq!(name.to_string().parse(), Ok(name));
        prop_assert_eq!(format!("{bits:#010x}").parse(), Ok(name));
        let [system, class, instance, local] = bits.to_be_bytes();
        let numbers = if hex {
            format!("{system:#x}.{class:#x}.{instance:#x}.{local:#x}")
        } else {
            format!("{system}.{class}.{instance}.{local}")
        };
        prop_assert_eq!(numbers.parse(), Ok(name));
        prop_assert_eq!(numbers.parse(), Ok(Pattern::exact(name)));
        prop_assert_eq!(MailboxName::new(system, Class(class), instance, local), name);
    }

    #[test]
    fn every_pattern_is_read_as_it_is_shown_and_matches_by_its_places(
        places in any::<[Option<u8>; 4]>(),
        bits in any::<u32>(),
        takes in any::<[bool; 4]>(),
    ) {
        let [system, class, instance, local] = places;
        let pattern = Pattern::new(system, class.map(Class), instance, local);
        prop_assert_eq!(pattern.to_string().parse(), Ok(pattern));
        // Some places of a random name are the pattern's own.
        let mut name = bits.to_be_bytes();
        for at in 0..4 {
            name[at] = places[at].filter(|_| takes[at]).unwrap_or(name[at]);
        }
        let expected = (0..4).all(|at| places[at].is_none_or(|place| place == name[at]));
        prop_assert_eq!(pattern.matches(MailboxName(u32::from_be_bytes(name))), expected);
        prop_assert_eq!(pattern.is_exact(), places.iter().all(Option::is_some));
    }

    #[test]
    fn no_text_whatever_panics(text in any::<String>(), marks in "[0-9a-zA-Z*./()xX+ -]{0,16}") {
        for text in [text, marks] {
            let (name, pattern) = (text.parse::<MailboxName>(), text.parse::<Pattern>());
            prop_assert!(name.is_err() || pattern.is_ok(), "each name is a pattern");
            let _ = (name.map_err(|error| error.to_string()), text.parse::<Class>());
        }
    }
}
