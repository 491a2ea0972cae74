//! A copy of the program under test, in a place where other users may run it.

use std::path::Path;
use std::process::Command;

/// Copies it by another process: a child of another test's thread, which was started while this one wrote, would have the copy open for
/// writing still, and Linux runs no such file ("Text file busy").
pub fn copy_program(from: &str, to: &Path) {
    let copied = Command::new("cp").arg(from).arg(to).status().expect("cp");
    assert!(copied.success(), "{from} cannot be copied to {}", to.display());
}
