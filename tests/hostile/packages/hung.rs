//! Components that hang, or hang up.

use super::*;

/// Sends to the sink for ever, numbered packages.
fn sends_for_ever(mut send: impl FnMut(&[u8]) -> bool) -> ! {
    for number in 1u64.. {
        while !send(&[number.to_ne_bytes(); 3].concat()) {
            thread::yield_now();
        }
    }
    unreachable!()
}

#[test]
fn one_that_hangs_while_it_has_a_lane_holds_up_nobody() {
    if let Some(station) = is_to_make_it() {
        let component = Component::attach(&station).unwrap();
        let mailbox = component.mailbox(MISTAKEN, Shape::new(1, 1)).unwrap();
        let mut sender = mailbox.sender(SINK).unwrap();
        sends_for_ever(|body| sender.send(1, body).is_ok());
    }
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 24).senders(2));
    let mistaken = Mistaken::begin("one_that_hangs_while_it_has_a_lane_holds_up_nobody", &station);
    let mut last = 0;
    for round in 0..10 {
        let before = last;
        eventually("it sends", || {
            read_in_order(&mut sink, &mut last);
            (last > before + 100).then_some(())
        });
        // At some instruction of sending, mostly.
        thread::sleep(Duration::from_micros(round * 37));
        mistaken.stop();
        // What it had sent is there, and no more; others go on.
        read_in_order(&mut sink, &mut last);
        let stopped = last;
        for _ in 0..20 {
            goes_on(&station, &mut sink);
        }
        assert_eq!(read_in_order(&mut sink, &mut last) + last - stopped, 0);
        mistaken.go_on();
    }
    assert_eq!(sink.counted(of_owner::NONSENSE) + sink.counted(of_owner::FORGED), 0);
}

#[test]
fn one_that_hangs_while_it_has_a_mailbox_refuses_what_does_not_fit_and_holds_up_nobody() {
    if let Some(station) = is_to_make_it() {
        // An echo.
        let component = Component::attach(&station).unwrap();
        let mut mailbox = component.mailbox(MISTAKEN, Shape::new(4, 24)).unwrap();
        let mut sender = mailbox.sender(SINK).unwrap();
        loop {
            let body = mailbox.receive(None).unwrap().body().to_vec();
            sender.send(3, &body).unwrap();
        }
    }
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(8, 24).senders(2));
    let test = "one_that_hangs_while_it_has_a_mailbox_refuses_what_does_not_fit_and_holds_up_nobody";
    let mistaken = Mistaken::begin(test, &station);
    let (_heir, heir) = station.mailbox(HEIR, Shape::new(1, 1));
    let mut sender = eventually("it is there", || heir.sender(MISTAKEN).ok());
    let mut number = 0u64;
    let mut send = |sender: &mut Sender| {
        number += 1;
        sender.send(1, &[number.to_ne_bytes(); 3].concat())
    };
    // It is at work.
    send(&mut sender).unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().head().kind, 3);
    mistaken.stop();
    (0..4).for_each(|_| assert!(send(&mut sender).is_ok()));
    let (begun, full) = (Instant::now(), Err(SendError::Mailbox(mailbox::SendError::Full(4))));
    (0..100_000).for_each(|_| assert_eq!(send(&mut sender), full));
    assert!(begun.elapsed() < PATIENCE, "nobody waits for it: {:?}", begun.elapsed());
    for _ in 0..20 {
        goes_on(&station, &mut sink);
        // It can be bound to, and left.
        drop(heir.sender(MISTAKEN).map_err(|error| error.to_string()));
    }
    mistaken.go_on();
    for expected in 2..6u64 {
        let package = sink.receive(Some(PATIENCE)).unwrap();
        assert_eq!(package.body().to_vec(), [expected.to_ne_bytes(); 3].concat());
    }
    send(&mut sender).unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().head().kind, 3);
}

#[test]
fn the_lane_of_one_that_has_hung_up_and_writes_on_is_nobodys_until_its_process_has_ended() {
    if let Some(station) = is_to_make_it() {
        let raw = Raw::connect(&station);
        assert!(matches!(raw.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
        let (mut lane, _) = raw.binds(MISTAKEN, SINK);
        drop(raw);
        let head = Head { from: MISTAKEN, to: SINK, ..Head::default() };
        let now = Stamps { sent: 1, ..Stamps::default() };
        sends_for_ever(|body| lane.send(&head, body, &now).is_ok());
    }
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 24).senders(1));
    let test = "the_lane_of_one_that_has_hung_up_and_writes_on_is_nobodys_until_its_process_has_ended";
    let mistaken = Mistaken::begin(test, &station);
    let mut last = 0;
    eventually("it sends", || {
        read_in_order(&mut sink, &mut last);
        (last > 0).then_some(())
    });
    // Its mailbox has gone with its connection; its name has not, as long as packages come from it.
    let heir_is = Component::attach(&station.path).unwrap();
    let heir = heir_is.mailbox(HEIR, Shape::new(1, 1)).unwrap();
    eventually("its mailbox has gone", || {
        (refused(heir.sender(MISTAKEN)) == Some(Refused::NoMailbox(MISTAKEN))).then_some(())
    });
    for _ in 0..200 {
        let before = last;
        eventually("it still sends", || {
            read_in_order(&mut sink, &mut last);
            (last > before).then_some(())
        });
        assert_eq!(refused(heir.sender(SINK)), Some(Refused::NoLane(SINK, 1)));
        assert_eq!(refused(heir_is.mailbox(MISTAKEN, Shape::new(1, 1))), Some(Refused::Taken(MISTAKEN)));
        // Some come and go meanwhile.
        drop(Raw::connect(&station.path));
    }
    drop(mistaken);
    let mut sender = eventually("its lane is free", || {
        read_in_order(&mut sink, &mut last);
        heir.sender(SINK).ok()
    });
    drop(heir_is.mailbox(MISTAKEN, Shape::new(1, 1)).expect("its name is free, too"));
    for count in 0..100u8 {
        sender.send(1, &[count]).unwrap();
        let package = sink.receive(Some(PATIENCE)).unwrap();
        assert_eq!((package.head().from, package.body().to_vec()), (HEIR, vec![count]));
    }
    assert_eq!(sink.counted(of_owner::NONSENSE) + sink.counted(of_owner::FORGED), 0);
}

#[test]
fn one_that_hangs_up_just_when_another_comes_keeps_its_lane_while_its_process_lives() {
    let (mut broker, path, _dir) = broker();
    let mut ask = |raw: &Raw, ask: Ask, files: &[&OwnedFd]| {
        raw.send(&ask.to_bytes(), files).unwrap();
        // It is let in, and answered in the next turn.
        (0..2).for_each(|_| broker.serve(Duration::from_millis(1)));
        raw.receive().expect("it answers")
    };
    let shape = Shape::new(4, 24).senders(1);
    let [of_sink, of_mistaken] = [(); 2].map(|()| files(&shape));
    let [sink, mistaken] = [(); 2].map(|()| Raw::connect(&path));
    assert!(matches!(ask(&sink, Ask::Create(SINK, shape), &of_sink.each_ref()).0, Answer::Created { .. }));
    assert!(matches!(
        ask(&mistaken, Ask::Create(MISTAKEN, shape), &of_mistaken.each_ref()).0,
        Answer::Created { .. }
    ));
    let (answer, files) = ask(&mistaken, Ask::Bind { from: MISTAKEN, to: SINK }, &[]);
    let (which, _lane) = lane_of(&answer, files);
    assert_eq!(ask(&mistaken, Ask::Ready(which), &[]).0, Answer::Done);
    // In the same turn one goes, whose process is this one, and another comes.
    drop(mistaken);
    let _another = Raw::connect(&path);
    for turn in 0..5 {
        broker.serve(Duration::from_millis(1));
        let registered = broker.registry().get(which.place).expect("the sink is there");
        let state = registered.lanes[which.lane].state;
        assert!(matches!(state, LaneState::Bound(_, MISTAKEN)), "turn {turn}: {state:?}, and it could write");
    }
    assert_eq!(broker.registry().find(MISTAKEN), None);
}

#[test]
fn who_hung_up_and_has_no_lane_any_more_takes_nobodys_seat() {
    let_there_be_descriptors();
    let (mut broker, path, _dir) = broker();
    let mut ask = |raw: &Raw, ask: Ask, files: &[&OwnedFd]| {
        raw.send(&ask.to_bytes(), files).unwrap();
        (0..2).for_each(|_| broker.serve(Duration::from_millis(1)));
        raw.receive().map(|(answer, _)| answer)
    };
    let shape = Shape::new(1, 1).senders(1);
    let brought = files(&shape);
    let sink = Raw::connect(&path);
    for count in 0..MOST_COMPONENTS + 10 {
        // It never says that it does not need its lane any more; but the mailbox is gone.
        let mistaken = Raw::connect(&path);
        for (raw, name) in [(&sink, SINK), (&mistaken, MISTAKEN)] {
            let told = ask(raw, Ask::Create(name, shape), &brought.each_ref());
            assert!(matches!(told, Some(Answer::Created { .. })), "behind {count} of them: {told:?}");
        }
        let told = ask(&mistaken, Ask::Bind { from: MISTAKEN, to: SINK }, &[]);
        let Some(Answer::Reserved { lane, .. }) = told else { panic!("{told:?}") };
        assert_eq!(ask(&mistaken, Ask::Ready(lane), &[]), Some(Answer::Done));
        drop(mistaken);
        assert_eq!(ask(&sink, Ask::Attach, &[]), Some(Answer::Done));
        assert_eq!(ask(&sink, Ask::Delete(SINK), &[]), Some(Answer::Done));
    }
}

#[test]
fn more_connections_than_there_may_be_are_hung_up_on_and_those_that_are_there_go_on() {
    let_there_be_descriptors();
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16));
    let (honest_is, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let connections: Vec<Raw> = (0..MOST_COMPONENTS + 50).map(|_| Raw::connect(&station.path)).collect();
    let is_let_in = |raw: &Raw| raw.send(&Ask::Attach.to_bytes(), &[]).is_ok() && raw.receive().is_some();
    let let_in = connections.iter().filter(|raw| is_let_in(raw)).count();
    assert_eq!(let_in, MOST_COMPONENTS - 2);
    let begun = Instant::now();
    assert!(Component::attach(&station.path).is_err());
    goes_on_beside(&honest, &mut sink);
    drop(honest_is.mailbox(HONEST.with_local(1), Shape::new(1, 1)).unwrap());
    assert!(begun.elapsed() < AT_ONCE, "{:?}", begun.elapsed());
    drop(connections);
    eventually("there is room", || Component::attach(&station.path).ok());
    goes_on_beside(&honest, &mut sink);
}

#[test]
fn who_does_not_take_its_answers_is_hung_up_on_and_holds_up_nobody() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(2));
    let mistaken = Raw::connect(&station.path);
    assert!(matches!(mistaken.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
    let mut asked = 0;
    let told = loop {
        match mistaken.send(&Ask::Delete(HEIR).to_bytes(), &[]) {
            Ok(()) => asked += 1,
            Err(error) => break error,
        }
        if asked % 64 == 0 {
            goes_on(&station, &mut sink);
        }
        assert!(asked < 100_000, "it still asks");
    };
    assert!(matches!(told, Errno::EPIPE | Errno::ECONNRESET), "{told}");
    goes_on(&station, &mut sink);
    let heir = Component::attach(&station.path).unwrap();
    eventually("its mailbox has gone", || heir.mailbox(MISTAKEN, Shape::new(1, 1)).ok());
}

#[test]
fn what_one_sent_that_went_before_it_rang_wakes_its_receiver_all_the_same() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16));
    let mistaken = Raw::connect(&station.path);
    assert!(matches!(mistaken.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
    let (mut lane, which) = mistaken.binds(MISTAKEN, SINK);
    // It is let in before it sends: that rings, too.
    assert_eq!(sink.receive(Some(Duration::from_millis(20))).err(), Some(ReceiveError::TimedOut));
    let (told, thread) = std::sync::mpsc::channel();
    let waits = thread::spawn(move || {
        told.send(this_thread()).unwrap();
        sink.receive(Some(PATIENCE)).map(|package| package.body().to_vec())
    });
    until_asleep(thread.recv().unwrap());
    let head = Head { from: MISTAKEN, to: SINK, ..Head::default() };
    assert_eq!(lane.send(&head, b"last", &Stamps { sent: 1, ..Stamps::default() }), Ok(true), "it sleeps");
    thread::sleep(Duration::from_millis(20));
    assert!(!waits.is_finished(), "nobody rang");
    let begun = Instant::now();
    assert_eq!(mistaken.ask(Ask::Unbind(which), &[]), Answer::Done);
    assert_eq!(waits.join().unwrap(), Ok(b"last".to_vec()));
    assert!(begun.elapsed() < AT_ONCE, "nobody rang: {:?}", begun.elapsed());
}

#[test]
fn who_waits_for_ever_is_told_that_its_station_has_ended() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16));
    let waits = thread::spawn(move || [(); 2].map(|()| sink.receive(None).err()));
    thread::sleep(Duration::from_millis(20));
    let begun = Instant::now();
    drop(station);
    assert_eq!(waits.join().unwrap(), [Some(ReceiveError::Gone); 2]);
    assert!(begun.elapsed() < AT_ONCE, "{:?}", begun.elapsed());
}

#[test]
fn a_process_that_has_hung_up_and_comes_again_may_have_its_own_names_again() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16));
    let mistaken = Raw::connect(&station.path);
    assert!(matches!(mistaken.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
    let (_lane, _) = mistaken.binds(MISTAKEN, SINK);
    let another = Raw::connect(&station.path);
    assert_eq!(another.creates(MISTAKEN, Shape::new(1, 1)), Answer::Refused(Refused::Taken(MISTAKEN)));
    // Its answer came too late, say: its lane it cannot give back any more, and its process lives.
    drop(mistaken);
    eventually("it is its own name", || {
        matches!(another.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }).then_some(())
    });
    goes_on(&station, &mut sink);
}
