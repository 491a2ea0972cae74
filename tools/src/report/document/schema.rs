//! The schema of each kind, as its type says, and as it is kept for who reads documents.

use std::path::Path;

use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde_json::{Value, json};

use super::Kind;

/// What writes all of them anew, if it is set.
const WRITE: &str = "RTNET_WRITE_SCHEMAS";

/// The schema in `docs/schema` is that of the type: a key that has gone, or means something else, is seen there.
pub fn is_kept<T: Kind + JsonSchema>() {
    let (kind, version) = (T::KIND, T::VERSION);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../docs/schema/{kind}.v{version}.json"));
    let schema = schema::<T>();
    let text = serde_json::to_string_pretty(&schema).unwrap() + "\n";
    if std::env::var_os(WRITE).is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let mut without = Vec::new();
    undescribed(&schema, &mut without);
    assert!(without.is_empty(), "{kind}: a doc comment says what each key means; none has {without:?}");
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        kept == text,
        "{} is not what is written: a key that is added needs `{WRITE}=1 cargo test -p rtnet-tools --lib schema`, one \
         that has gone or means something else a larger Kind::VERSION, too",
        path.display()
    );
}

fn schema<T: Kind + JsonSchema>() -> Value {
    let generator = SchemaSettings::draft2020_12().for_serialize().into_generator();
    let mut schema = generator.into_root_schema_for::<T>().to_value();
    take_more(&mut schema);
    schema["title"] = T::KIND.into();
    schema["properties"]["kind"] = json!({ "const": T::KIND });
    schema["properties"]["version"] = json!({ "const": T::VERSION });
    let required = schema["required"].as_array_mut().expect("a document has keys");
    required.splice(0..0, ["kind".into(), "version".into()]);
    schema
}

/// The keys of which nothing says what they mean.
fn undescribed(schema: &Value, without: &mut Vec<String>) {
    let Value::Object(object) = schema else {
        return schema.as_array().into_iter().flatten().for_each(|one| undescribed(one, without));
    };
    let properties = object.get("properties").and_then(Value::as_object);
    for (key, of) in properties.into_iter().flatten() {
        let is_said = ["description", "const", "$ref"].iter().any(|said| of.get(said).is_some());
        without.extend((!is_said).then(|| key.clone()));
    }
    object.values().for_each(|of| undescribed(of, without));
}

/// Keys may be added.
fn take_more(schema: &mut Value) {
    if let Value::Object(object) = schema {
        if object.get("additionalProperties") == Some(&false.into()) {
            object.remove("additionalProperties");
        }
        object.values_mut().for_each(take_more);
    } else if let Value::Array(all) = schema {
        all.iter_mut().for_each(take_more);
    }
}
