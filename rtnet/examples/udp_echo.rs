//! Sends back whatever comes: `cargo run --example udp_echo -- STATION [PORT]`, with a station that was started with `--ip`.

mod shared;

use std::net::{Ipv4Addr, SocketAddrV4};
use std::process::ExitCode;

use rtnet::api::Station;
use rtnet::socket::Sender;

fn main() -> ExitCode {
    shared::end(run())
}

fn run() -> Result<(), String> {
    let mut args = std::env::args().skip(1);
    let name = args.next().ok_or("usage: udp_echo STATION [PORT]")?;
    let port = args.next().unwrap_or("36000".into());
    let port = shared::read(&port, "PORT: write 1 to 65535")?;
    let failed = shared::of(&name);
    let socket = Station::named(&name).and_then(|station| station.udp()).map_err(&failed)?;
    socket.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)).map_err(&failed)?;
    let port = socket.local_addr().map_err(&failed)?.port();
    println!("{name} echoes what comes to port {port}");
    let mut room = [0; 1500];
    loop {
        let received = socket.receive(&mut room).map_err(&failed)?;
        if let Sender::Udp(from) = received.from
            && let Err(error) = socket.send_to(&room[..received.len], from)
        {
            eprintln!("an answer could not leave: {error}");
        }
    }
}
