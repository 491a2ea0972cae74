//! Sends back whatever comes: `cargo run --example udp_echo -- STATION [PORT]`, with a station that was started with `--ip`.

use std::error::Error;
use std::net::{Ipv4Addr, SocketAddrV4};

use rtnet::api::Station;
use rtnet::socket::Sender;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let name = args.next().ok_or("usage: udp_echo STATION [PORT]")?;
    let port = args.next().map_or(Ok(36_000), |port| port.parse())?;
    let socket = Station::named(&name)?.udp()?;
    socket.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port))?;
    println!("{name} echoes what comes to port {port}");
    let mut room = [0; 1500];
    loop {
        let received = socket.receive(&mut room)?;
        if let Sender::Udp(from) = received.from
            && let Err(error) = socket.send_to(&room[..received.len], from)
        {
            eprintln!("an answer could not leave: {error}");
        }
    }
}
