/** The panels of the page: importing one registers it. */
import "./groups/panel";
import "./compare/panel";
