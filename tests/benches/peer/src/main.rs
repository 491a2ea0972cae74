//! iceoryx2 as one end of tests/benches/packages, there and back between two processes: see its `trips`.

#[path = "../../packages/exchange.rs"]
mod exchange;
// It counts what is lost, too: nothing is here.
#[allow(dead_code)]
#[path = "../../trips/figures.rs"]
mod figures;

use std::time::Duration;

use anyhow::{Result, anyhow, bail};
use exchange::{End, Message, Way, echoes, pings, set_up};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;

struct Iceoryx {
    says: Publisher<ipc::Service, Message, ()>,
    hears: Subscriber<ipc::Service, Message, ()>,
    _node: Node<ipc::Service>,
}

impl Iceoryx {
    /// Number 0 asks, number 1 answers.
    fn open(place: &str, number: usize) -> Result<Self> {
        let node = NodeBuilder::new().create::<ipc::Service>().map_err(odd)?;
        let service = |number: usize| {
            let name = format!("rtnet-{place}-{}", ["there", "back"][number]);
            let builder = node.service_builder(&name.as_str().try_into().map_err(odd)?);
            builder.publish_subscribe::<Message>().open_or_create().map_err(odd)
        };
        let says = service(number)?.publisher_builder().create().map_err(odd)?;
        let hears = service(1 - number)?.subscriber_builder().create().map_err(odd)?;
        Ok(Self { says, hears, _node: node })
    }
}

impl End for Iceoryx {
    fn say(&mut self, message: &Message) -> Result<()> {
        self.says.loan_uninit().map_err(odd)?.write_payload(*message).send().map_err(odd)?;
        Ok(())
    }

    fn hear(&mut self, room: &mut Message) -> Result<()> {
        loop {
            if let Some(sample) = self.hears.receive().map_err(odd)? {
                *room = *sample.payload();
                return Ok(());
            }
            core::hint::spin_loop();
        }
    }
}

fn odd(error: impl core::fmt::Debug) -> anyhow::Error {
    anyhow!("{error:?}")
}

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let ["trips", side, "iceoryx2", way, core, time, place] = arguments[..] else {
        bail!("it is started by tests/benches/packages");
    };
    set_log_level(LogLevel::Error);
    let (way, core): (Way, usize) = (way.parse()?, core.parse()?);
    if side == "answers" {
        let mut end = Iceoryx::open(place, 1)?;
        println!("ready");
        set_up(way, core);
        return echoes(&mut end);
    }
    let mut end = Iceoryx::open(place, 0)?;
    set_up(way, core);
    println!("{}", pings(&mut end, Duration::try_from_secs_f64(time.parse()?)?)?);
    Ok(())
}
