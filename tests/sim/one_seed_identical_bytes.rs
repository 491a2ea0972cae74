//! Everything random follows from the seed.

use std::cell::RefCell;
use std::rc::Rc;

use rtnet::sim::capture::Capture;
use rtnet::sim::{Host, Medium};
use tests::networks::Plan;
use tools::scenario::Uniform;

fn capture(seed: u64) -> Vec<u8> {
    let plan = Plan::of(&Uniform { seed, ..Plan::lab_options(8) }).on(Host::VIRTUAL_MACHINE);
    let medium = Medium { lose_control_ppm: 10_000, lose_data_ppm: 1_000, ..plan.medium };
    let mut lab = Plan { medium, ..plan }.build();
    let capture = Rc::new(RefCell::new(Capture::new()));
    let writing = capture.clone();
    lab.network.observe(move |aired| writing.borrow_mut().frame(aired.at, aired.bytes));
    lab.run_cycles(3_000);
    capture.borrow().bytes().to_vec()
}

#[test]
fn two_runs_with_one_seed_are_identical_and_another_differs() {
    let first = capture(1);
    assert!(first.len() > 3_000 * 100, "something was sent");
    assert!(first == capture(1), "one seed, two captures");
    assert!(first != capture(2), "two seeds, one capture");
}
