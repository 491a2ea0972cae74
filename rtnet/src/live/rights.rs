//! Which capability a process lacks, and where it is to be had: root of a container lacks many.

use std::fs;

/// Those that are of use here, and their numbers: capabilities(7).
const NUMBERS: [(&str, u32); 6] = [
    ("CAP_NET_ADMIN", 12),
    ("CAP_NET_RAW", 13),
    ("CAP_IPC_LOCK", 14),
    ("CAP_SYS_ADMIN", 21),
    ("CAP_SYS_NICE", 23),
    ("CAP_BPF", 39),
];
/// The user map of a process outside of all user namespaces.
const ALL_USERS: [&str; 3] = ["0", "0", "4294967295"];

/// The remedy where the kernel refuses something that these capabilities allow.
pub fn remedy(needed: &[&str]) -> String {
    let users = fs::read_to_string("/proc/thread-self/uid_map").unwrap_or_default();
    let is_host = users.split_whitespace().eq(ALL_USERS);
    let status = fs::read_to_string("/proc/thread-self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let effective = effective.and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok());
    let root = nix::unistd::geteuid().is_root() && is_host;
    remedy_of(needed, effective.filter(|_| root))
}

/// `effective` is what root of the host has; nothing of whoever else it is.
fn remedy_of(needed: &[&str], effective: Option<u64>) -> String {
    let Some(effective) = effective else {
        return format!("run as root, or give {}", needed.join(" and "));
    };
    let has = |name: &str| {
        NUMBERS.iter().any(|(known, number)| *known == name && effective & (1_u64 << number) != 0)
    };
    let missing: Vec<&str> = needed.iter().copied().filter(|name| !has(name)).collect();
    if missing.is_empty() {
        let needed = needed.join(" and ");
        return format!(
            "this process has {needed}: a policy of the host forbids it, seccomp, AppArmor or SELinux; allow it there"
        );
    }
    let (names, options) = (missing.join(" and "), missing.iter().map(|name| short(name)));
    let options: Vec<String> = options.map(|name| format!("--cap-add {name}")).collect();
    format!(
        "this process is root without {names}: give it that, in a container by `{}`, in a service by CapabilityBoundingSet=",
        options.join(" ")
    )
}

/// As container engines call it.
fn short(name: &str) -> &str {
    name.strip_prefix("CAP_").unwrap_or(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remedy_names_what_root_lacks() {
        let both = ["CAP_BPF", "CAP_NET_ADMIN"];
        assert_eq!(remedy_of(&both, None), "run as root, or give CAP_BPF and CAP_NET_ADMIN");
        let lacking = remedy_of(&both, Some(1 << 39));
        assert!(lacking.starts_with("this process is root without CAP_NET_ADMIN: "), "{lacking}");
        assert!(lacking.contains("`--cap-add NET_ADMIN`") && !lacking.contains("as root"), "{lacking}");
        let none = remedy_of(&both, Some(0));
        assert!(
            none.contains("without CAP_BPF and CAP_NET_ADMIN") && none.contains("--cap-add BPF --cap-add")
        );
        assert!(remedy_of(&both, Some(u64::MAX)).contains("a policy of the host forbids it"));
    }
}
