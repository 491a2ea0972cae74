//! The shortest cycle that has room for so many stations, as a file for labs and simulations.

use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;
use rtnet::wire::ethernet::HEADER_LEN;

use crate::report::figures::Role;
use crate::scenario::{Scenario, ScenarioError, StationPlan, Uniform, default_duration};

/// No slave follows a longer one.
const LONGEST_MICROS: i64 = 100_000_000;

/// The network of the shortest cycle, in whole microseconds, that has room for `network`'s stations; its own cycle and duration do
/// not count: it lasts as long as a file of that cycle does that gives no duration. A `lab run` with the same options and a shorter
/// cycle is refused.
///
/// # Errors
/// No cycle has.
pub fn shortest(network: &Uniform) -> Result<Scenario, ScenarioError> {
    let with = |micros: i64| {
        let cycle = Span::from_micros(micros);
        Uniform { cycle, duration: default_duration(cycle), ..network.clone() }.scenario()
    };
    // Whatever is wrong with the longest is wrong with all.
    with(LONGEST_MICROS)?;
    let (mut low, mut high) = (1, LONGEST_MICROS);
    while low < high {
        let middle = (low + high) / 2;
        if with(middle).is_ok() { high = middle } else { low = middle + 1 }
    }
    with(high)
}

/// A network of equal slots as a file that is read as just that.
pub fn file(scenario: &Scenario) -> String {
    let Scenario { cycle, sync_window, rate, guard, .. } = scenario;
    let mut text = format!(
        "{}cycle = \"{cycle}\"\nrate = \"{}\"\nsync_window = \"{sync_window}\"\nguard = \"{guard}\"\n",
        sum(scenario),
        rate_text(*rate)
    );
    for StationPlan { name, role, payload, slots, .. } in &scenario.stations {
        let role = if *role == Role::Master { "master" } else { "slave" };
        text += &format!("\n[[station]]\nname = \"{name}\"\nrole = \"{role}\"\npayload = {payload}\n");
        let slots = slots.iter().map(|slot| format!("{{ id = {}, offset = \"{}\" }}", slot.id, slot.offset));
        text += &format!("slots = [{}]\n", slots.collect::<Vec<_>>().join(", "));
    }
    text
}

/// What stands in the cycle, as a comment.
fn sum(scenario: &Scenario) -> String {
    let Scenario { cycle, sync_window, rate, guard, .. } = scenario;
    let (n, payload) = (scenario.stations.len(), scenario.stations[0].payload);
    let air = rate.air_time(payload + HEADER_LEN);
    let sum = *sync_window + (air + *guard) * n as i64;
    let schedule = scenario.schedule();
    let shorter = Scenario { cycle: *cycle - Span::from_micros(1), ..scenario.clone() };
    let why = shorter.check_fit().err();
    let why = why.map_or(String::new(), |why| format!("# In a cycle of {}, {why}.\n", shorter.cycle));
    format!(
        "# {n} stations, a slot of {payload} bytes each in every cycle; {:.1} % of the time is used.\n# sync window {sync_window} + \
         {n} x (frame {air} + guard band {guard}) = {sum} of {cycle}\n{why}",
        schedule.utilisation() * 100.0
    )
}

/// As files have it: `100M`.
fn rate_text(rate: Rate) -> String {
    let bits = rate.bits_per_second();
    match bits {
        giga if giga.is_multiple_of(1_000_000_000) => format!("{}G", giga / 1_000_000_000),
        mega if mega.is_multiple_of(1_000_000) => format!("{}M", mega / 1_000_000),
        _ => format!("{}k", bits as f64 / 1e3),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::scenario::Source;

    fn network(stations: usize, payload: usize, rate: u64, guard_us: i64) -> Uniform {
        Uniform {
            stations,
            cycle: Span::ZERO,
            duration: Span::from_millis(10_000),
            payload,
            rate: Rate::from_bits_per_second(rate),
            guard: Some(Span::from_micros(guard_us)),
            seed: 1,
            vnic: None,
        }
    }

    #[test]
    fn twenty_stations_at_100_mbits_need_1461_us() {
        let shortest = shortest(&network(20, 200, 100_000_000, 50)).unwrap();
        // 80us + 20 x (19.04us + 50us) = 1460.8us.
        assert_eq!((shortest.cycle, shortest.sync_window), (Span::from_micros(1_461), Span::from_micros(80)));
    }

    /// Ten cycles of it last longer than 10 s.
    #[test]
    fn a_cycle_of_seconds_is_read_as_it_was_proposed() {
        let scenario = shortest(&network(3, 933, 1_000, 0)).unwrap();
        assert_eq!(scenario.duration, scenario.cycle * 10);
        assert_eq!(Source::new("net.toml", &file(&scenario)).parse().unwrap(), scenario);
    }

    #[test]
    fn what_no_cycle_has_room_for_is_refused_as_a_lab_does() {
        let refused = |network: Uniform| shortest(&network).unwrap_err().to_string();
        assert_eq!(refused(network(1, 200, 1_000_000, 50)), "1 stations: there must be 2 to 10000");
        let long = refused(network(200, 200, 1_000_000_000, 1_000_000));
        assert!(long.starts_with("200 slots do not fit a cycle of 100s"), "{long}");
    }

    proptest! {
        #[test]
        fn the_file_is_read_as_the_network_and_a_microsecond_less_has_no_room(
            stations in 2usize..60, payload in 46usize..1500, rate in 1u64..2_000_000, guard in 0i64..500,
        ) {
            let asked = network(stations, payload, rate * 1_000, guard);
            let scenario = shortest(&asked).unwrap();
            prop_assert_eq!(Source::new("net.toml", &file(&scenario)).parse().unwrap(), scenario.clone());
            let shorter = Uniform { cycle: scenario.cycle - Span::from_micros(1), ..asked };
            prop_assert!(matches!(shorter.scenario(), Err(
                ScenarioError::Conflict(_) | ScenarioError::Refused(_) | ScenarioError::Unfit(_)
            )));
        }
    }
}
