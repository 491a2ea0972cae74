//! Files that are not what a mailbox lies in.

use super::*;

#[test]
fn files_that_are_too_short_not_sealed_too_few_or_too_many_make_no_mailbox() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(3));
    let (called, shape) = (c"too-odd", Shape::new(4, 100).senders(2));
    let [owner, lanes, set] = files_called(called, &shape);
    let size = |file: &OwnedFd| fstat(file).unwrap().st_size as usize;
    let short = file(called, size(&owner) - 4096, final_seals());
    let unsealed = file(called, size(&owner), SealFlag::F_SEAL_FUTURE_WRITE);
    let with_holes = file(called, size(&owner), SealFlag::F_SEAL_SHRINK);
    let few = file(called, size(&lanes) - 1, SealFlag::F_SEAL_SHRINK);
    let null: OwnedFd = std::fs::File::open("/dev/null").unwrap().into();
    let (pipe, _writes) = nix::unistd::pipe().unwrap();
    for files in [
        &[][..],
        &[&owner],
        &[&owner, &lanes],
        &[&lanes, &set],
        &[&lanes, &owner, &set],
        &[&short, &lanes, &set],
        &[&unsealed, &lanes, &set],
        &[&with_holes, &lanes, &set],
        &[&null, &lanes, &set],
        &[&pipe, &lanes, &set],
        &[&owner, &few, &set],
        &[&owner, &null, &set],
        &[&owner, &pipe, &set],
        &[&owner, &lanes, &null],
        &[&owner, &lanes, &pipe],
        &[&owner, &set, &lanes],
    ] {
        let mistaken = Raw::connect(&station.path);
        let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), files);
        assert!(matches!(answer, Answer::Failed(_)), "{files:?}: {answer:?}");
    }
    // More than are taken: it may be hung up on, or refused.
    for files in [&[&owner, &lanes, &set, &null][..], &[&owner; 10]] {
        let mistaken = Raw::connect(&station.path);
        for ask in [Ask::Attach, Ask::Create(MISTAKEN, shape)] {
            if mistaken.send(&ask.to_bytes(), files).is_err() {
                break;
            }
            match mistaken.receive() {
                None => break,
                Some((answer, _)) => assert!(!matches!(answer, Answer::Created { .. }), "{answer:?}"),
            }
        }
    }
    // The name is nobody's.
    let mistaken = Raw::connect(&station.path);
    let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), &[&owner, &lanes, &set]);
    assert!(matches!(answer, Answer::Created { .. }), "{answer:?}");
    goes_on(&station, &mut sink);
    drop((mistaken, owner, lanes, short, unsealed, with_holes, few));
    eventually("no file is left", || (descriptors(called) == 0).then_some(()));
}

#[test]
fn lanes_that_could_be_cut_short_are_written_by_nobody() {
    let station = Station::new();
    let (_honest, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let mistaken = Raw::connect(&station.path);
    let shape = Shape::new(4, 100).senders(2);
    let [owner, lanes, set] = files(&shape);
    let unsealed = file(c"mistaken", fstat(&lanes).unwrap().st_size as usize, SealFlag::empty());
    match mistaken.ask(Ask::Create(SINK, shape), &[&owner, &unsealed, &set]) {
        Answer::Created { .. } => {
            // As often as there are lanes, and more.
            for _ in 0..5 {
                assert!(matches!(honest.sender(SINK), Err(Error::Io(_))));
            }
            ftruncate(&unsealed, 0).unwrap();
            assert!(matches!(honest.sender(SINK), Err(Error::Io(_))));
        }
        answer => assert!(matches!(answer, Answer::Failed(_)), "{answer:?}"),
    }
}

#[test]
fn a_file_that_is_longer_than_its_mailbox_takes_no_more_memory_than_that() {
    const BYTES: usize = 256 << 20;
    let station = Station::new();
    let mistaken = Raw::connect(&station.path);
    let shape = Shape::new(1, 8).senders(1);
    let [_, lanes, set] = files(&shape);
    let owner = file(c"mistaken", BYTES, final_seals());
    assert_eq!(fstat(&owner).unwrap().st_blocks, 0);
    let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), &[&owner, &lanes, &set]);
    let taken = fstat(&owner).unwrap().st_blocks * 512;
    assert!(taken <= 1 << 20, "{answer:?}: the broker took {taken} bytes for a mailbox of some thousand");
}

// ---- how they hang and go ----
