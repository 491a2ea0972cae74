use super::*;
use std::os::unix::net::UnixStream;

/// A view of which every part says which one it is.
fn view(n: u64) -> TimeView {
    TimeView {
        state: STATES[(n % 5) as usize],
        cycle: n as u32,
        start: Instant::from_nanos(n.wrapping_mul(3)),
        offset: Offset::between(Instant::default(), GlobalTime::from_nanos(n.wrapping_mul(5))),
        period: Some(Span::from_nanos(n as i64 + 1)),
        drift_ppb: -(n as i64),
        holdover: n as u16,
    }
}

#[test]
fn every_state_is_read_as_it_was_shown() {
    let mut publisher = TimePublisher::new(EmulatedClock::default());
    let board = publisher.board();
    assert_eq!(board.read(), TimeView::default());
    for n in 0..10 {
        publisher.publish(&view(n));
        assert_eq!(board.read(), view(n));
    }
}

#[test]
fn what_is_shown_already_is_not_shown_again() {
    let mut publisher = TimePublisher::new(EmulatedClock::default());
    publisher.publish(&view(7));
    publisher.publish(&view(7));
    assert_eq!(publisher.board().page[SHOWN].load(Ordering::Relaxed), 2, "what nobody knows yet, and this");
}

#[test]
fn threads_that_read_while_it_is_shown_never_see_half_of_a_view() {
    /// That each reader is to see: some of them, on any machine, while they are being written.
    const DIFFERENT: u64 = 300;
    let mut publisher = TimePublisher::new(EmulatedClock::default());
    publisher.publish(&view(0));
    let read = |board: Arc<TimeBoard>| {
        let (mut last, mut different) = (0, 0);
        while different < DIFFERENT {
            let seen = board.read();
            let number = seen.period.unwrap().nanos() as u64 - 1;
            assert_eq!(seen, view(number), "torn");
            assert!(number >= last, "what is older never comes again");
            different += u64::from(number > last);
            last = number;
        }
    };
    let reader = |board| std::thread::spawn(move || read(board));
    let readers: Vec<_> = (0..3).map(|_| reader(publisher.board())).collect();
    let mut n = 0;
    while readers.iter().any(|reader| !reader.is_finished()) {
        n += 1;
        publisher.publish(&view(n));
    }
    readers.into_iter().for_each(|reader| reader.join().unwrap());
}

#[test]
fn a_writer_that_was_stopped_in_the_middle_holds_nobody_up() {
    let mut publisher = TimePublisher::new(EmulatedClock::default());
    let board = publisher.board();
    publisher.publish(&view(1));
    publisher.publish(&view(2));
    // As far as it had come with the next.
    board.face(board.page[SHOWN].load(Ordering::Relaxed) + 1)[0].store(u64::MAX, Ordering::Relaxed);
    assert_eq!(board.read(), view(2));
}

#[test]
fn times_are_of_the_stations_own_clock() {
    let clock = EmulatedClock { anchor: 0, offset: Span::from_millis(-700), drift_ppb: 50_000 };
    let mut publisher = TimePublisher::new(clock);
    let board = publisher.board();
    let start = board.now();
    assert!((start - clock.local(monotonic())).abs() < Span::from_millis(1_000));
    // By the master's clock the same moment is at 9 s.
    let global = GlobalTime::from_nanos(9_000_000_000);
    let offset = Offset::between(start, global);
    let (state, period) = (SyncState::Locked, Some(Span::from_millis(1)));
    publisher.publish(&TimeView { state, cycle: 1, start, offset, period, drift_ppb: 50_000, holdover: 1 });
    let later = start + Span::from_nanos(1_000_050_000);
    assert_eq!(board.to_global(later).unwrap() - global, Span::from_millis(1_000));
    assert_eq!(board.to_local(global + Span::from_millis(1_000)), Some(later));
}

#[test]
fn a_station_whose_clock_is_set_shows_its_time_by_that() {
    let mut publisher = TimePublisher::new(EmulatedClock::default());
    let board = publisher.board();
    publisher.publish(&view(2));
    let before = board.now();
    publisher.set_clock(EmulatedClock::default().stepped(Span::from_millis(60_000)));
    let gone = board.now() - before;
    assert!((60_000..70_000).contains(&(gone.nanos() / 1_000_000)), "{gone}");
    assert_eq!(board.read(), view(2), "what it takes the time for");
}

#[test]
fn a_station_that_has_ended_is_synchronised_no_more() {
    let mut publisher = TimePublisher::new(EmulatedClock::default());
    let board = publisher.board();
    let period = Some(Span::from_millis(100_000));
    let locked = TimeView { state: SyncState::Locked, start: board.now(), period, ..view(2) };
    publisher.publish(&locked);
    assert_eq!(board.state(), SyncState::Locked);
    drop(publisher);
    assert_eq!(board.state(), SyncState::Lost);
    assert!(board.global_now().is_some_and(|(_, state)| state == SyncState::Lost));
}

/// The board of this station as another process has it, and the station's end of the connection.
fn elsewhere(publisher: &TimePublisher) -> (io::Result<Arc<TimeBoard>>, UnixStream) {
    let (station, program) = UnixStream::pair().unwrap();
    let page = publisher.board.page().expect("this kernel has memfd_create").try_clone_to_owned().unwrap();
    (TimeBoard::open(page, program.into()), station)
}

#[test]
fn another_process_reads_what_the_stations_threads_read() {
    let clock = EmulatedClock { anchor: 7, offset: Span::from_millis(-700), drift_ppb: 50_000 };
    let mut publisher = TimePublisher::new(clock);
    let (board, _station) = elsewhere(&publisher);
    let (board, here) = (board.unwrap(), publisher.board());
    for n in 0..10 {
        publisher.publish(&view(n));
        assert_eq!(board.read_both(), here.read_both());
        assert_eq!(board.to_global(here.now()).is_some(), view(n).period.is_some());
    }
    publisher.set_clock(clock.stepped(Span::from_millis(60_000)));
    assert_eq!(board.clock(), clock.stepped(Span::from_millis(60_000)));
    assert!(!board.has_ended());
    drop(publisher);
    assert!(board.has_ended() && board.state() == SyncState::Lost, "though nobody has hung up yet");
}

#[test]
fn of_a_station_that_was_killed_another_process_learns_by_being_hung_up_on() {
    let mut publisher = TimePublisher::new(EmulatedClock::default());
    let (board, station) = elsewhere(&publisher);
    let board = board.unwrap();
    let period = Some(Span::from_millis(100_000));
    publisher.publish(&TimeView { state: SyncState::Locked, start: board.now(), period, ..view(2) });
    assert!(!board.has_ended() && board.state() == SyncState::Locked);
    drop(station);
    assert_eq!(board.state(), SyncState::Locked, "nobody has asked yet");
    assert!(board.has_ended() && board.state() == SyncState::Lost);
}

#[test]
fn a_page_in_another_order_or_of_another_clock_is_refused() {
    for (word, value, kind, expected) in [
        (IS, VERSION + 1, io::ErrorKind::InvalidData, "same version of rtnet"),
        (CLOCKS, 1, io::ErrorKind::Unsupported, "another time namespace"),
    ] {
        let publisher = TimePublisher::new(EmulatedClock::default());
        assert!(elsewhere(&publisher).0.is_ok());
        publisher.board.page[word].store(value, Ordering::Relaxed);
        let refused = elsewhere(&publisher).0.err().unwrap();
        assert!(refused.kind() == kind && refused.to_string().contains(expected), "{refused}");
    }
}
