// Lists the REST interface from its OpenAPI description.
(async () => {
  const make = (tag, text, children = []) => {
    const element = document.createElement(tag);
    if (text) element.textContent = text;
    element.append(...children);
    return element;
  };
  const api = await (await fetch("/api/openapi.json")).json();
  const typed = (schema) => schema?.$ref?.split("/").pop() || (schema?.anyOf || []).map(typed).join(" or ") || (schema?.enum || []).join(" | ") || schema?.const || schema?.type || "";
  const page = document.getElementById("docs");
  const intro = "Send the token as `Authorization: Bearer TOKEN`. Binary answers: 4 bytes (little-endian) say how long the JSON manifest is that follows, after it come its arrays.";
  page.append(make("h1", `${api.info.title} ${api.info.version}`), make("p", api.info.description), make("p", intro));
  const link = make("a", "The same as OpenAPI (JSON)");
  link.href = "/api/openapi.json";
  page.append(make("p", "", [link]));
  for (const [path, verbs] of Object.entries(api.paths)) {
    for (const [verb, { summary, parameters = [], requestBody }] of Object.entries(verbs)) {
      const rows = parameters.map(({ name, in: where, schema, required }) => make("li", `${name} (${where}${required ? "" : ", optional"}): ${typed(schema)}`));
      const body = requestBody?.content?.["application/json"]?.schema;
      if (body) rows.push(make("li", `body: ${typed(body)}`));
      page.append(make("section", "", [make("h3", `${verb.toUpperCase()} ${path}`), make("p", summary), make("ul", "", rows)]));
    }
  }
  page.append(make("h2", "Bodies"));
  for (const [name, { properties = {}, description }] of Object.entries(api.components.schemas)) {
    const rows = Object.entries(properties).map(([key, schema]) => make("li", `${key}: ${typed(schema)}`));
    page.append(make("section", "", [make("h3", name), make("p", description || ""), make("ul", "", rows)]));
  }
})();
