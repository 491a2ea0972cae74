//! The schedule is changed while the network runs: what is on the medium is looked at by both schedules.

mod killed;
mod medium;
mod parts;
mod undisturbed;

use std::cell::RefCell;
use std::rc::Rc;

use rtmac::tdma::TdmaCommand;
use rtmac::tdma::change::{Activation, ChangeStatus};
use rtmac::wire::change::ScheduleId;
use rtnet::sim::Host;
use rtnet::time::Span;
use tests::networks::{Lab, Plan};

use medium::Watch;

const STATIONS: usize = 5;
/// Who may take the master's place, if anybody, and how long after a cycle's start they look.
const LOOK: [(usize, Span); 2] = [(1, Span::from_micros(100)), (2, Span::from_micros(200))];

/// A network, and the schedule that it is to have instead: every station in the place of another.
struct Changing {
    lab: Lab,
    /// The schedules by number; there may be many.
    schedules: Vec<Plan>,
    watch: Rc<RefCell<Watch>>,
}

fn plan(backups: usize) -> Plan {
    let mut options = Plan::lab_options(STATIONS);
    options.cycle = Span::from_millis(2);
    let plan = Plan::of(&options).on(Host::IDEAL).with_backups(&LOOK[..backups]).with_rounds(5);
    Plan { changes: true, ..plan }
}

/// The same with the places of all slots turned by one, in a cycle of this length.
fn turned(plan: &Plan, cycle: Span) -> Plan {
    let mut other = plan.clone();
    let offsets: Vec<Span> = plan.scenario.stations.iter().map(|station| station.slots[0].offset).collect();
    for (id, station) in other.scenario.stations.iter_mut().enumerate() {
        station.slots[0].offset = offsets[(id + 1) % STATIONS];
    }
    other.scenario.cycle = cycle;
    other
}

impl Changing {
    /// All are locked, and nothing has been changed yet.
    fn running(first: Plan, second: Plan) -> Self {
        let mut lab = first.build();
        let watch = Rc::new(RefCell::new(Watch::new(vec![first.clone(), second.clone()])));
        let watching = watch.clone();
        lab.network.observe(move |aired| watching.borrow_mut().see(aired));
        lab.run_until_locked();
        lab.run_cycles(5);
        Changing { lab, schedules: vec![first, second], watch }
    }

    fn propose(&mut self, activation: Option<Activation>) -> Result<u32, String> {
        let book = self.schedules[1].scenario.book().unwrap();
        self.lab.command(0, TdmaCommand::Propose(book, activation))
    }

    fn change(&self, id: usize) -> ChangeStatus {
        self.lab.status(id).change.expect("it takes part in changes")
    }

    fn in_use(&self, id: usize) -> u16 {
        let ScheduleId { number, .. } = self.change(id).in_use;
        number
    }

    /// So many of a million frames are lost on their way to a station.
    fn lose(&mut self, ppm: u32) {
        let medium = self.lab.network.medium_mut();
        (medium.lose_control_ppm, medium.lose_data_ppm) = (ppm, ppm);
    }

    fn run_cycles(&mut self, cycles: u64) {
        self.lab.run_cycles(cycles);
    }
}
